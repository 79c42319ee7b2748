// What the mapper does with keyframes and Gaussians beside rendering, as `services/mapping/kernels.py`, `keyframe.py`
// and `common/mapfiles/store.py`. Poses are float64, as there.
//
// State of a keyframe, float64 [KEYFRAME_STATE]; the offsets are those of `keyframe_states.py`.
#define DELTA 0              // [4, 4] the mapper's correction of the pose
#define POSE_FIRST 16        // [6] Adam's moments of the pose
#define POSE_SECOND 22
#define POSE_STEPS 28
#define EXPOSURE 29          // [6] log gains, offsets: values of float32
#define EXPOSURE_FIRST 35
#define EXPOSURE_SECOND 41
#define EXPOSURE_STEPS 47

__device__ void multiply(const double *A, const double *B, double *out) {  // [4, 4] each
    for (int r = 0; r < 4; ++r)
        for (int c = 0; c < 4; ++c) {
            double x = 0;
            for (int k = 0; k < 4; ++k) x += A[4 * r + k] * B[4 * k + c];
            out[4 * r + c] = x;
        }
}

// One thread: the camera of a step, T_camera_map = (T_map_camera delta)^-1, and its exposure.
KERNEL(32) begin_step(BeginArguments s) {
    if (threadIdx.x) return;
    const double *state = s.row < 0 ? nullptr : s.states + (long long)s.row * KEYFRAME_STATE;
    double T[16];
    for (int k = 0; k < 16; ++k) T[k] = s.T_map_camera[k];
    if (state) multiply(s.T_map_camera, state + DELTA, T);
    for (int r = 0; r < 3; ++r) {
        double x = 0;
        for (int k = 0; k < 3; ++k) {
            s.camera[3 * r + k] = (float)T[4 * k + r];
            x += T[4 * k + r] * T[4 * k + 3];
        }
        s.camera[9 + r] = (float)-x;
    }
    for (int k = 0; k < 12; ++k) s.camera[12 + k] = s.intrinsics[k];
    const float luma[3] = {LUMA_R, LUMA_G, LUMA_B};
    double offset = 0;
    for (int c = 0; c < 3; ++c) {
        const double log_gain = state ? state[EXPOSURE + c] : (double)s.exposure[c];
        const double shift = state ? state[EXPOSURE + 3 + c] : (double)s.exposure[3 + c];
        const float gain = (float)exp(log_gain);
        s.tone[c] = gain;
        s.tone[3 + c] = (float)shift;
        s.tone[6 + c] = luma[c] * gain;
        offset += (double)luma[c] * shift;
    }
    s.tone[9] = (float)offset;
    *s.keyframe = s.row;
}

// Sum of a column of `parts` [rows, columns] in float64, by one warp, in one order.
__device__ double column_sum(const float *parts, int rows, int columns, int column) {
    double x = 0;
    for (int row = threadIdx.x % 32; row < rows; row += 32) x += (double)parts[(long long)row * columns + column];
    for (int offset = 16; offset; offset >>= 1) x += __shfl_xor_sync(FULL, x, offset);
    return x;
}

// Adam's step of six values (Kingma & Ba 2015); updates the moments.
__device__ void adam_of_six(const double *gradient, double *first, double *second, double t, double *move) {
    const double fix_1 = 1.0 - pow(0.9, t), fix_2 = 1.0 - pow(0.99, t);
    #pragma unroll 1
    for (int k = 0; k < 6; ++k) {
        first[k] += 0.1 * (gradient[k] - first[k]);
        second[k] += 0.01 * (gradient[k] * gradient[k] - second[k]);
        move[k] = first[k] / fix_1 / (sqrt(second[k] / fix_2) + 1e-12);
    }
}

// out = I + a W + b W^2 with W = skew(phi).
__device__ void rotation_series(const double *phi, double a, double b, double *out) {
    const double x = phi[0], y = phi[1], z = phi[2], n = x * x + y * y + z * z;
    const double w[9] = {0, -z, y, z, 0, -x, -y, x, 0};
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c) {
            const double square = phi[r] * phi[c] - (r == c ? n : 0.0);
            out[3 * r + c] = (r == c ? 1.0 : 0.0) + a * w[3 * r + c] + b * square;
        }
}

__device__ double norm_of(const double *phi) { return sqrt(phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]); }

// T = exp(tangent) [4, 4], tangent = (rho, phi): Rodrigues' formula, and the left Jacobian.
__device__ void se3_exp(const double *tangent, double *T) {
    const double *rho = tangent, *phi = tangent + 3, angle = norm_of(phi), square = angle * angle;
    double R[9], J[9];
    if (angle < 1e-5) {
        rotation_series(phi, 1.0 - square / 6.0, 0.5, R);
        rotation_series(phi, 0.5, 1.0 / 6.0, J);
    } else {
        const double half = sin(0.5 * angle), versed = 2.0 * half * half / square;  // (1 - cos) / angle^2
        rotation_series(phi, sin(angle) / angle, versed, R);
        rotation_series(phi, versed, (angle - sin(angle)) / (square * angle), J);
    }
    for (int r = 0; r < 3; ++r) {
        for (int c = 0; c < 3; ++c) T[4 * r + c] = R[3 * r + c];
        T[4 * r + 3] = J[3 * r] * rho[0] + J[3 * r + 1] * rho[1] + J[3 * r + 2] * rho[2];
        T[12 + r] = 0.0;
    }
    T[15] = 1.0;
}

// The tangent (rho, phi) of T [4, 4], for rotations below 3 rad: corrections are limited to a fraction of that.
__device__ void se3_log(const double *T, double *tangent) {
    const double axis[3] = {0.5 * (T[9] - T[6]), 0.5 * (T[2] - T[8]), 0.5 * (T[4] - T[1])};  // sin(angle) * axis
    const double sine = norm_of(axis), angle = atan2(sine, 0.5 * (T[0] + T[5] + T[10] - 1.0)), square = angle * angle;
    const double scale = sine > 1e-12 ? angle / sine : 1.0;
    double *rho = tangent, *phi = tangent + 3, J[9];
    for (int k = 0; k < 3; ++k) phi[k] = scale * axis[k];
    const double half = 0.5 * angle;
    const double b = angle < 1e-3 ? 1.0 / 12.0 + square / 720.0 : (1.0 - half * cos(half) / sin(half)) / square;
    rotation_series(phi, -0.5, b, J);  // inverse of the left Jacobian
    for (int r = 0; r < 3; ++r) rho[r] = J[3 * r] * T[3] + J[3 * r + 1] * T[7] + J[3 * r + 2] * T[11];
}

// delta <- exp(clip(log(delta exp(step)))), see `refine_pose`.
__device__ void refine_pose(const FinishArguments &s, double *state) {
    double move[6], turn[16], moved[16], tangent[6];
    adam_of_six(s.pose_gradient, state + POSE_FIRST, state + POSE_SECOND, ++state[POSE_STEPS], move);
    for (int k = 0; k < 6; ++k) move[k] *= s.pose_rates[k / 3];
    se3_exp(move, turn);
    multiply(state + DELTA, turn, moved);
    se3_log(moved, tangent);
    for (int k = 0; k < 6; ++k) tangent[k] = fmin(fmax(tangent[k], -s.pose_limits[k / 3]), s.pose_limits[k / 3]);
    se3_exp(tangent, state + DELTA);
}

// One step of Adam on log gains and offsets, with a weak prior for no change, see `refine_exposure`.
__device__ void refine_exposure(const FinishArguments &s, double *state) {
    double gradient[6], move[6], *exposure = state + EXPOSURE;
    for (int k = 0; k < 6; ++k) gradient[k] = s.exposure_gradient[k] + (double)(1e-3f * (float)exposure[k]);
    adam_of_six(gradient, state + EXPOSURE_FIRST, state + EXPOSURE_SECOND, ++state[EXPOSURE_STEPS], move);
    for (int k = 0; k < 6; ++k) exposure[k] = (double)(float)(exposure[k] - s.exposure_rate * move[k]);
}

// One block: adds up the losses and the gradients of pose and exposure, writes the loss to its place, and takes the
// steps of pose and exposure. The first four columns are losses, then six of the pose and six of the exposure.
KERNEL(256) finish_step(FinishArguments s) {
    __shared__ double totals[16];
    for (int column = threadIdx.x / 32; column < 16; column += 8) {
        double x = 0;
        if (column < 2) x = column_sum(s.pixel_parts, s.pixel_blocks, 2, column);
        else if (column == 2) x = column_sum(s.beam_parts, s.beam_blocks, 1, 0);
        else if (column == 3) x = column_sum(s.ssim_parts, s.ssim_blocks, 1, 0);
        else if (column < 10 && s.with_pose) x = column_sum(s.pose_parts, s.pose_blocks, 6, column - 4);
        else if (column >= 10 && s.with_exposure) x = column_sum(s.exposure_parts, s.pixel_blocks, 6, column - 10);
        if (threadIdx.x % 32 == 0) totals[column] = x;
    }
    __syncthreads();
    if (threadIdx.x) return;
    double loss = totals[0] * s.colour_scale + totals[1] + totals[2];
    if (s.ssim_blocks) loss += 0.5 * s.ssim_weight * (1.0 - totals[3] / s.pixels);
    const int at = *s.loss_count;
    if (at < s.loss_room) s.losses[at] = (float)loss;
    *s.loss_count = at + 1;
    for (int k = 0; k < 6; ++k) {
        s.pose_gradient[k] = totals[4 + k];
        s.exposure_gradient[k] = totals[10 + k];
    }
    if (*s.keyframe < 0) return;
    double *state = s.states + (long long)*s.keyframe * KEYFRAME_STATE;
    if (s.with_pose) refine_pose(s, state);
    if (s.with_exposure) refine_exposure(s, state);
}

// One thread a Gaussian: adds a vote if it floats in front of a trusted surface, see `count_carving_votes`.
KERNEL(256) vote_carving(CarveArguments s) {
    const int i = blockIdx.x * 256 + threadIdx.x, n = s.stride, plane = s.width * s.height;
    if (i >= s.count) return;
    const float *p = s.params + i, *c = s.camera;
    const float x = p[0], y = p[n], z = p[2 * n];
    const float zc = c[6] * x + c[7] * y + c[8] * z + c[11];
    if (!(zc >= c[22])) return;
    const double left = floor((double)((c[0] * x + c[1] * y + c[2] * z + c[9]) / zc * c[12] + c[14]) + 0.5);
    const double top = floor((double)((c[3] * x + c[4] * y + c[5] * z + c[10]) / zc * c[13] + c[15]) + 0.5);
    if (!(left >= 0.0 && top >= 0.0 && left < s.width && top < s.height)) return;
    const int at = (int)top * s.width + (int)left;
    if (weight_of(s.targets, plane)[at] < s.least_weight) return;
    const float d = (float)depth_mm_of(s.targets)[at] * 1e-3f;
    const float size = expf(fmaxf(p[SCALE * n], fmaxf(p[(SCALE + 1) * n], p[(SCALE + 2) * n])));
    if (d > 0.0f && (double)zc + 3.0 * (double)size < (double)d * (1.0 - s.margin)) s.votes[i] += 1;
}

// One thread a Gaussian: rigid motion of mean, rotation and Adam's first moments, see `transform_with_momentum`.
KERNEL(256) move_gaussians(MoveArguments s) {
    const int k = blockIdx.x * 256 + threadIdx.x, n = s.stride;
    if (k >= s.count) return;
    const double w = s.quat[0], x = s.quat[1], y = s.quat[2], z = s.quat[3], *R = s.rotation;
    #pragma unroll
    for (int which = 0; which < 2; ++which) {
        float *p = (which ? s.first : s.params) + s.columns[k];
        const double a = p[0], b = p[n], c = p[2 * n];
        #pragma unroll
        for (int r = 0; r < 3; ++r)
            p[r * n] = (float)(R[3 * r] * a + R[3 * r + 1] * b + R[3 * r + 2] * c + (which ? 0.0 : s.translation[r]));
        float *q = p + QUAT * n;
        const double q0 = q[0], q1 = q[n], q2 = q[2 * n], q3 = q[3 * n];
        q[0] = (float)(w * q0 - x * q1 - y * q2 - z * q3);
        q[n] = (float)(x * q0 + w * q1 - z * q2 + y * q3);
        q[2 * n] = (float)(y * q0 + z * q1 + w * q2 - x * q3);
        q[3 * n] = (float)(z * q0 - y * q1 + x * q2 + w * q3);
    }
}
