// From the sums of a splat on the image to the gradients of its Gaussian and of the camera pose, and Adam. As
// `project_backward.py` and `optimiser.py`.

struct AxesGradient {  // gradients of centre (px), of the rows of V and of M
    float u, v, V0[3], V1[3], M[9];
};

// Adds up the slots of a Gaussian's pairs, which are neighbours in memory, in the order of its tiles.
__device__ Moments sum_slots(const RasterArguments &s, int first, int end) {
    Moments m = {0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0};
    for (int k = first; k < end; ++k) {
        const float4 a = s.slots[3 * k], b = s.slots[3 * k + 1], c = s.slots[3 * k + 2];
        m.v += a.x; m.x += a.y; m.y += a.z; m.xx += a.w;
        m.xy += b.x; m.yy += b.y; m.r += b.z; m.g += b.w;
        m.b += c.x; m.z += c.y; m.w += c.z;
    }
    return m;
}

__device__ void screen_to_axes(const Moments &m, const Projection &h, AxesGradient &d) {
    const float k = 1.0f / (h.a * h.d - h.b * h.b);
    const float a = h.d * k, b = -h.b * k, c = h.a * k;  // the conic: sigma = (a dx^2 + 2 b dx dy + c dy^2) / 2
    d.u = a * m.x + b * m.y;
    d.v = b * m.x + c * m.y;
    // dL/dcov = -K G K with G = -1/2 [[xx, xy], [xy, yy]], and dL/dV = 2 dL/dcov V.
    const float p00 = a * m.xx + b * m.xy, p01 = a * m.xy + b * m.yy;
    const float p10 = b * m.xx + c * m.xy, p11 = b * m.xy + c * m.yy;
    const float h00 = p00 * a + p01 * b, h01 = p00 * b + p01 * c, h11 = p10 * b + p11 * c;
    #pragma unroll
    for (int j = 0; j < 3; ++j) {
        d.V0[j] = h00 * h.V0[j] + h01 * h.V1[j];
        d.V1[j] = h01 * h.V0[j] + h11 * h.V1[j];
        d.M[j] = h.j00 * d.V0[j];
        d.M[3 + j] = h.j11 * d.V1[j];
        d.M[6 + j] = h.j02 * d.V0[j] + h.j12 * d.V1[j];
    }
}

// dL/d(centre in the camera frame), through the pixel, the depth and the Jacobian J.
__device__ void point_gradient(const float *c, float depth, const Projection &h, const AxesGradient &d, float *g) {
    const float d00 = d.V0[0] * h.M[0] + d.V0[1] * h.M[1] + d.V0[2] * h.M[2];
    const float d02 = d.V0[0] * h.M[6] + d.V0[1] * h.M[7] + d.V0[2] * h.M[8];
    const float d11 = d.V1[0] * h.M[3] + d.V1[1] * h.M[4] + d.V1[2] * h.M[5];
    const float d12 = d.V1[0] * h.M[6] + d.V1[1] * h.M[7] + d.V1[2] * h.M[8];
    float x = d.u * h.j00, y = d.v * h.j11;
    float z = depth - (x * h.xc + y * h.yc) * h.inverse_z;
    z += h.inverse_z * h.inverse_z * (d02 * h.ux * c[12] + d12 * h.uy * c[13] - d00 * c[12] - d11 * c[13]);
    const float sx = h.xc * h.inverse_z, sy = h.yc * h.inverse_z;
    const float gux = sx > c[16] && sx < c[17] ? -d02 * h.inverse_z * c[12] : 0.0f;
    const float guy = sy > c[18] && sy < c[19] ? -d12 * h.inverse_z * c[13] : 0.0f;
    g[0] = x + gux * h.inverse_z;
    g[1] = y + guy * h.inverse_z;
    g[2] = z - (gux * sx + guy * sy) * h.inverse_z;
}

// Gradient of the stored quaternion, through dL/dR_q = R_camera_map^T dL/dM diag(s).
__device__ void quat_gradient(const float *c, const Projection &h, const float *dM, float *out) {
    const float scale[3] = {h.s0, h.s1, h.s2};
    float N[9];
    #pragma unroll
    for (int r = 0; r < 3; ++r)
        #pragma unroll
        for (int j = 0; j < 3; ++j)
            N[3 * r + j] = (dM[j] * c[r] + dM[3 + j] * c[3 + r] + dM[6 + j] * c[6 + r]) * scale[j];
    const float w = h.qw, x = h.qx, y = h.qy, z = h.qz;
    const float gw = 2 * (x * (N[7] - N[5]) + y * (N[2] - N[6]) + z * (N[3] - N[1]));
    const float gx = 2 * (w * (N[7] - N[5]) + y * (N[1] + N[3]) + z * (N[2] + N[6]) - 2 * x * (N[4] + N[8]));
    const float gy = 2 * (w * (N[2] - N[6]) + x * (N[1] + N[3]) + z * (N[5] + N[7]) - 2 * y * (N[0] + N[8]));
    const float gz = 2 * (w * (N[3] - N[1]) + x * (N[2] + N[6]) + y * (N[5] + N[7]) - 2 * z * (N[0] + N[4]));
    const float along = w * gw + x * gx + y * gy + z * gz;
    out[0] = (gw - w * along) * h.inverse_norm;
    out[1] = (gx - x * along) * h.inverse_norm;
    out[2] = (gy - y * along) * h.inverse_norm;
    out[3] = (gz - z * along) * h.inverse_norm;
}

// exp(phi) rotates the centre p and the axes M_k: dL/dphi = p x dL/dp + sum over axes M_k x dL/dM_k.
__device__ void pose_gradient(const Projection &h, const float *g, const float *dM, float *pose) {
    const float *M = h.M;
    pose[0] = g[0]; pose[1] = g[1]; pose[2] = g[2];
    pose[3] = h.yc * g[2] - h.zc * g[1];
    pose[4] = h.zc * g[0] - h.xc * g[2];
    pose[5] = h.xc * g[1] - h.yc * g[0];
    #pragma unroll
    for (int j = 0; j < 3; ++j) {
        pose[3] += M[3 + j] * dM[6 + j] - M[6 + j] * dM[3 + j];
        pose[4] += M[6 + j] * dM[j] - M[j] * dM[6 + j];
        pose[5] += M[j] * dM[3 + j] - M[3 + j] * dM[j];
    }
}

// One step of Adam on Gaussian i, with the isotropy term (see `optimiser.adam`); `weight` is its blending weight.
__device__ void adam_step(const RasterArguments &s, int i, float *g, float weight) {
    const int n = s.stride;
    const float t = s.steps[i] + 1.0f;
    s.steps[i] = t;
    const float fix_1 = -1.0f / expm1f(t * LN_BETA_1), fix_2 = -1.0f / expm1f(t * LN_BETA_2);  // 1 / (1 - beta^t)
    const float a = s.params[SCALE * n + i], b = s.params[(SCALE + 1) * n + i], c = s.params[(SCALE + 2) * n + i];
    const float longest = fmaxf(a, fmaxf(b, c)), middle = fmaxf(fminf(a, b), fminf(fmaxf(a, b), c));
    const float pull = fmaxf(longest - middle - s.rates[PARAMS + 1], 0.0f) * s.rates[PARAMS] * weight;
    if (a >= longest) g[SCALE] += pull;
    if (b >= longest) g[SCALE + 1] += pull;
    if (c >= longest) g[SCALE + 2] += pull;
    #pragma unroll
    for (int row = 0; row < PARAMS; ++row) {
        const int at = row * n + i;
        const float m = s.first[at] + (g[row] - s.first[at]) * ADAM_1;
        const float v = s.second[at] + (g[row] * g[row] - s.second[at]) * ADAM_2;
        s.first[at] = m;
        s.second[at] = v;
        s.params[at] -= m * fix_1 / (sqrtf(v * fix_2) + EPSILON) * s.rates[row];
    }
}

// Writes the gradients of Gaussian i to G [GRADIENTS] and its part of the pose gradient to pose [6].
__device__ void gaussian_gradient(const RasterArguments &s, int i, const Moments &m, float *G, float *pose) {
    Projection h;
    AxesGradient d;
    float g[3];
    const float *c = s.camera;
    if (!project_gaussian(s, i, h)) return;
    screen_to_axes(m, h, d);
    point_gradient(c, m.z, h, d, g);
    #pragma unroll
    for (int j = 0; j < 3; ++j) {
        G[j] = g[0] * c[j] + g[1] * c[3 + j] + g[2] * c[6 + j];
        G[SCALE + j] = h.M[j] * d.M[j] + h.M[3 + j] * d.M[3 + j] + h.M[6 + j] * d.M[6 + j];
    }
    quat_gradient(c, h, d.M, G + QUAT);
    G[OPACITY] = m.v / (1.0f + expf(s.params[OPACITY * s.stride + i]));  // v (1 - opacity)
    G[COLOUR] = m.r; G[COLOUR + 1] = m.g; G[COLOUR + 2] = m.b;
    G[SCREEN_GRADIENT] = sqrtf(d.u * d.u + d.v * d.v);
    G[WEIGHT] = m.w;
    pose_gradient(h, g, d.M, pose);
}

// Adds what the colour depends on through the direction: the centre, and the place of the camera, which a left
// perturbation rho of the pose moves by -R^T rho.
__device__ void add_turned(const RasterArguments &s, int i, float *G, float *pose) {
    const float *c = s.camera;
    float turned[3];
    #pragma unroll
    for (int a = 0; a < 3; ++a) {
        turned[a] = s.turned[a * s.stride + i];
        G[a] += turned[a];
    }
    #pragma unroll
    for (int r = 0; r < 3; ++r) pose[r] += c[3 * r] * turned[0] + c[3 * r + 1] * turned[1] + c[3 * r + 2] * turned[2];
}

// One thread a Gaussian. Gaussians with no weight in the image have no gradient and take no step.
KERNEL(256) chain(RasterArguments s) {
    __shared__ float parts[256 / 32][6];
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    float G[GRADIENTS] = {0}, pose[6] = {0};
    const int n = i < *s.count ? s.pair_count[i] : 0;
    if (n) {
        const int first = s.first_pair[i];
        const Moments m = sum_slots(s, first, min(first + n, s.pairs));
        if (m.w > 0.0f) {
            gaussian_gradient(s, i, m, G, pose);
            if (s.harmonic_terms) add_turned(s, i, G, pose);
            if (s.learn) adam_step(s, i, G, m.w);
        }
    }
    if (s.rows && i < s.stride)
        #pragma unroll
        for (int row = 0; row < GRADIENTS; ++row) s.rows[row * s.stride + i] = G[row];
    #pragma unroll
    for (int j = 0; j < 6; ++j) {
        float x = pose[j];
        #pragma unroll
        for (int offset = 16; offset; offset >>= 1) x += __shfl_xor_sync(FULL, x, offset);
        if (threadIdx.x % 32 == 0) parts[threadIdx.x / 32][j] = x;
    }
    __syncthreads();
    if (threadIdx.x < 6) {
        float x = 0;
        for (int warp = 0; warp < 256 / 32; ++warp) x += parts[warp][threadIdx.x];
        s.pose_parts[blockIdx.x * 6 + threadIdx.x] = x;
    }
}
