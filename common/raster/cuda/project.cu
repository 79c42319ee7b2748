// Projection of Gaussians to splats on the image, and the pairs of splats and tiles. As `project.py`: EWA splatting,
// V = J R_camera_map R_q diag(s), covariance V V^T + blur.

struct Projection {
    float xc, yc, zc;                      // centre in the camera frame, m
    float qw, qx, qy, qz, inverse_norm;    // unit quaternion, and 1 / norm of the stored one
    float s0, s1, s2;                      // standard deviations, m
    float M[9], V0[3], V1[3];              // R_camera_map R_q diag(s) by rows; rows of V = J M
    float a, b, d;                         // covariance on the image with blur, px^2
    float inverse_z, ux, uy;               // 1/z; x/z and y/z clamped to the slope limits
    float j00, j02, j11, j12;              // entries of J that are not zero
};

__device__ void rotate_and_scale(const RasterArguments &s, int i, Projection &h) {
    const float *p = s.params + i, *c = s.camera;
    const int n = s.stride;
    const float w = p[QUAT * n], x = p[(QUAT + 1) * n], y = p[(QUAT + 2) * n], z = p[(QUAT + 3) * n];
    h.inverse_norm = 1.0f / sqrtf(fmaxf(w * w + x * x + y * y + z * z, 1e-24f));
    h.qw = w * h.inverse_norm; h.qx = x * h.inverse_norm; h.qy = y * h.inverse_norm; h.qz = z * h.inverse_norm;
    h.s0 = expf(p[SCALE * n]); h.s1 = expf(p[(SCALE + 1) * n]); h.s2 = expf(p[(SCALE + 2) * n]);
    const float R[9] = {
        1 - 2 * (h.qy * h.qy + h.qz * h.qz), 2 * (h.qx * h.qy - h.qw * h.qz), 2 * (h.qx * h.qz + h.qw * h.qy),
        2 * (h.qx * h.qy + h.qw * h.qz), 1 - 2 * (h.qx * h.qx + h.qz * h.qz), 2 * (h.qy * h.qz - h.qw * h.qx),
        2 * (h.qx * h.qz - h.qw * h.qy), 2 * (h.qy * h.qz + h.qw * h.qx), 1 - 2 * (h.qx * h.qx + h.qy * h.qy)};
    #pragma unroll
    for (int r = 0; r < 3; ++r) {
        h.M[3 * r] = (R[0] * c[3 * r] + R[3] * c[3 * r + 1] + R[6] * c[3 * r + 2]) * h.s0;
        h.M[3 * r + 1] = (R[1] * c[3 * r] + R[4] * c[3 * r + 1] + R[7] * c[3 * r + 2]) * h.s1;
        h.M[3 * r + 2] = (R[2] * c[3 * r] + R[5] * c[3 * r + 1] + R[8] * c[3 * r + 2]) * h.s2;
    }
}

// Projects Gaussian i; returns false if it is not in front of the near plane.
__device__ bool project_gaussian(const RasterArguments &s, int i, Projection &h) {
    const float *p = s.params + i, *c = s.camera;
    const int n = s.stride;
    const float x = p[0], y = p[n], z = p[2 * n];
    h.xc = c[0] * x + c[1] * y + c[2] * z + c[9];
    h.yc = c[3] * x + c[4] * y + c[5] * z + c[10];
    h.zc = c[6] * x + c[7] * y + c[8] * z + c[11];
    if (!(h.zc > c[22])) return false;
    rotate_and_scale(s, i, h);
    h.inverse_z = 1.0f / h.zc;
    h.ux = fminf(fmaxf(h.xc * h.inverse_z, c[16]), c[17]);
    h.uy = fminf(fmaxf(h.yc * h.inverse_z, c[18]), c[19]);
    h.j00 = h.inverse_z * c[12]; h.j02 = -h.ux * h.inverse_z * c[12];
    h.j11 = h.inverse_z * c[13]; h.j12 = -h.uy * h.inverse_z * c[13];
    #pragma unroll
    for (int k = 0; k < 3; ++k) {
        h.V0[k] = h.j00 * h.M[k] + h.j02 * h.M[6 + k];
        h.V1[k] = h.j11 * h.M[3 + k] + h.j12 * h.M[6 + k];
    }
    h.a = h.V0[0] * h.V0[0] + h.V0[1] * h.V0[1] + h.V0[2] * h.V0[2] + BLUR_PX2;
    h.b = h.V0[0] * h.V1[0] + h.V0[1] * h.V1[1] + h.V0[2] * h.V1[2];
    h.d = h.V1[0] * h.V1[0] + h.V1[1] * h.V1[1] + h.V1[2] * h.V1[2] + BLUR_PX2;
    return true;
}

struct Ellipse {  // where alpha is 1/255: A x^2 + B x y + C y^2 + level = 0 about the centre (x, y), px
    float x, y, A, B, C, level, half_width, half_height;
};

// sqrt(B^2 x^2 - 4 C (A x^2 + level)) without its cancellation: the extent of the ellipse at x, times 2 |C|.
__device__ float root_at(const Ellipse &e, float x) {
    const float ratio = x / e.half_width;
    return sqrtf(fmaxf(-4.0f * e.C * e.level * (1.0f - ratio) * (1.0f + ratio), 0.0f));
}

// Finds the rows of pixels y0 ... y1 of the ellipse in a column of tiles; returns false if there are none. They are
// bounded by the highest and the lowest point of the ellipse in the column, y = (-B x -+ root) / 2 C.
__device__ bool rows_in_column(const Ellipse &e, int column, bool whole, int bottom, int &y0, int &y1) {
    const float slack = 1e-3f;
    float low = -e.half_height, high = e.half_height;
    if (!whole) {
        const float x_top = -0.5f * e.B * e.half_height / e.A, half_over_c = 0.5f / e.C;
        const float left = fmaxf((float)(column * TILE) - e.x, -e.half_width);
        const float right = fminf((float)(column * TILE + TILE - 1) - e.x, e.half_width);
        if (left > right + slack) return false;
        if (x_top < left || x_top > right) {
            const float x = fminf(fmaxf(x_top, left), right);
            high = (-e.B * x - root_at(e, x)) * half_over_c;
        }
        if (-x_top < left || -x_top > right) {
            const float x = fminf(fmaxf(-x_top, left), right);
            low = (-e.B * x + root_at(e, x)) * half_over_c;
        }
    }
    y0 = (int)ceilf(fmaxf(e.y + low - slack, 0.0f));
    y1 = (int)floorf(fminf(e.y + high + slack, (float)bottom));
    return y0 <= y1;
}

// Returns the number of tiles that the splat overlaps, exact per column of tiles. Writes its first `limit` pairs to
// places at, at + 1, ...; those beyond the capacity are dropped.
__device__ int list_tiles(const RasterArguments &s, float4 r0, float4 r1, float half_width, float half_height,
                          int at, int limit, int gaussian) {
    const Ellipse e = {r0.x, r0.y, r0.z, r0.w, r1.x, r1.y - LOG2_ALPHA_MIN, half_width, half_height};
    const float right = s.width - 1, bottom = s.height - 1;
    if (!(e.level > 0.0f)) return 0;  // alpha is below 1/255 at the centre, or NaN
    if (!(e.x + half_width >= 0.0f && e.x - half_width <= right)) return 0;
    if (!(e.y + half_height >= 0.0f && e.y - half_height <= bottom)) return 0;
    const int first = (int)fmaxf(e.x - half_width, 0.0f) / TILE, last = (int)fminf(e.x + half_width, right) / TILE;
    int n = 0;
    for (int column = first; column <= last; ++column) {
        int y0, y1;
        if (!rows_in_column(e, column, first == last, s.height - 1, y0, y1)) continue;
        for (int row = y0 / TILE; row <= y1 / TILE; ++row, ++n)
            if (n < limit && at + n < s.pairs) {
                s.pair_tile[at + n] = (short)(row * s.tiles_x + column);
                s.pair_gaussian[at + n] = gaussian;
            }
    }
    return n;
}

// One thread a Gaussian: its record, its depth, and the number of its pairs.
KERNEL(256) project(RasterArguments s) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= s.stride) return;
    Projection h;
    int n = 0;
    if (i < *s.count && project_gaussian(s, i, h)) {
        const float *p = s.params + i, *c = s.camera;
        const float k = 1.0f / fmaxf(h.a * h.d - h.b * h.b, 1e-12f);
        const float log_opacity = log2f(fmaxf(1.0f / (1.0f + expf(-p[OPACITY * s.stride])), 1e-30f));
        const float reach = 2.0f * (log_opacity - LOG2_ALPHA_MIN) / LOG2_E;  // d^T cov^-1 d where alpha is 1/255
        const float half_width = sqrtf(fmaxf(reach * h.a, 0.0f)), half_height = sqrtf(fmaxf(reach * h.d, 0.0f));
        const float u = h.xc * h.inverse_z * c[12] + c[14], v = h.yc * h.inverse_z * c[13] + c[15];
        const float4 r0 = make_float4(u, v, h.d * k * (-0.5f * LOG2_E), h.b * k * LOG2_E);
        const float4 r1 = make_float4(h.a * k * (-0.5f * LOG2_E), log_opacity, s.shown[i], s.shown[s.stride + i]);
        n = list_tiles(s, r0, r1, half_width, half_height, 0, 0, i);
        if (n) {
            s.records[3 * i] = r0;
            s.records[3 * i + 1] = r1;
            s.records[3 * i + 2] = make_float4(s.shown[2 * s.stride + i], h.zc, half_width, half_height);
        }
    }
    s.pair_count[i] = n;
    s.depth[i] = n ? h.zc : FAR;
}

// One thread a place in the order: the pairs of the Gaussian there. So the pairs beyond the capacity are the farthest.
KERNEL(256) emit(RasterArguments s) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= s.stride) return;
    const int gaussian = (int)s.order[i], n = s.pair_count[gaussian], at = s.pair_end[i] - n;
    s.first_pair[gaussian] = at;
    if (i == s.stride - 1) *s.most_pairs = max(*s.most_pairs, s.pair_end[i]);
    if (n == 0 || at >= s.pairs) return;
    const float4 r2 = s.records[3 * gaussian + 2];
    const int listed = list_tiles(s, s.records[3 * gaussian], s.records[3 * gaussian + 1], r2.z, r2.w, at, n, gaussian);
    // The compiler may round here otherwise than in `project`: pairs that were counted and not listed have no sums.
    for (int k = at + listed; k < min(at + n, s.pairs); ++k)
        for (int j = 0; j < 3; ++j) s.slots[3 * k + j] = make_float4(0, 0, 0, 0);
}
