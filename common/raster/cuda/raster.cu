// Alpha blending of the splats of a tile, front to back, and its gradient. As `tiles.py`; no atomics: every sum has
// one order, which the counts fix and not the scheduling.
#define FULL 0xffffffffu

// Returns log2(alpha) of a splat at (dx, dy) px from its centre. The same instructions in both passes: both end a
// pixel at the same splat.
__device__ float power_at(float4 r0, float C, float log_opacity, float dx, float dy) {
    return __fmaf_rn(dx, __fmaf_rn(r0.z, dx, __fmul_rn(r0.w, dy)), __fmaf_rn(__fmul_rn(C, dy), dy, log_opacity));
}

// One block a tile, one thread a pixel. T is the transmittance; T < 0: the pixel has ended. The states of the pixels
// before each bucket of splats are kept, so that the backward pass can process all buckets at the same time.
KERNEL(PIXELS) forward(RasterArguments s) {
    __shared__ float4 splats[3][PIXELS];
    const int tile = blockIdx.x, at = threadIdx.x;
    const int u = tile % s.tiles_x * TILE + at % TILE, v = tile / s.tiles_x * TILE + at / TILE;
    const bool inside = u < s.width && v < s.height;
    const int first = s.tile_start[tile], end = min(s.tile_start[tile + 1], s.pairs);
    const float px = u, py = v;
    float *state = s.states + (long long)s.group_start[tile] * (GROUP / BUCKET) * CHANNELS * PIXELS + at;
    float T = inside ? 1.0f : -1.0f, r = 0, g = 0, b = 0, d = 0;
    int begin = first;
    for (; begin < end; begin += PIXELS) {
        if (__syncthreads_and(T < 0.0f)) break;
        const int k = begin + at, n = min(PIXELS, end - begin);
        if (k < end) {
            const float4 *record = s.records + 3 * s.pair_gaussian[s.sorted_pair[k]];
            splats[0][at] = record[0]; splats[1][at] = record[1]; splats[2][at] = record[2];
        }
        __syncthreads();
        for (int base = 0; base < n; base += BUCKET, state += CHANNELS * PIXELS) {
            state[0] = T;
            state[PIXELS] = r; state[2 * PIXELS] = g; state[3 * PIXELS] = b; state[4 * PIXELS] = d;
            if (__all_sync(FULL, T < 0.0f)) continue;
            const int stop = min(n, base + BUCKET);
            for (int j = base; j < stop; ++j) {
                const float4 r0 = splats[0][j], r1 = splats[1][j];
                const float power = power_at(r0, r1.x, r1.y, px - r0.x, py - r0.y);
                if (power >= LOG2_ALPHA_MIN && T > 0.0f) {
                    const float alpha = fminf(exp2f(power), ALPHA_MAX);
                    const float w = __fmul_rn(T, alpha), after = __fsub_rn(T, w);
                    if (after > MIN_TRANSMITTANCE) {
                        const float4 r2 = splats[2][j];
                        r += w * r1.z; g += w * r1.w; b += w * r2.x; d += w * r2.y;
                        T = after;
                    } else T = -T;
                }
            }
        }
    }
    if (at == 0) s.tile_used[tile] = begin - first;
    if (inside) {
        const int plane = s.width * s.height;
        float *o = s.image + v * s.width + u;
        o[0] = r; o[plane] = g; o[2 * plane] = b; o[3 * plane] = d; o[4 * plane] = 1.0f - fabsf(T);
    }
}

// Sums of a splat over pixels: v = alpha dL/dalpha, times powers of (dx, dy); weight times dL/d(r g b z); weight.
struct Moments {
    float v, x, y, xx, xy, yy, r, g, b, z, w;
};

// The last tile whose first group is not after `group`.
__device__ int tile_of(const RasterArguments &s, int group) {
    int tile = 0;
    for (int step = 1 << (31 - __clz(s.tiles)); step; step >>= 1)
        if (tile + step < s.tiles && s.group_start[tile + step] <= group) tile += step;
    return tile;
}

// Reads the states before a bucket into `feed`: (T, Q) of each pixel. Q is what lies behind, weighted by dL/d(image).
__device__ void load_feed(const RasterArguments &s, const float *state, const float4 *grad, const float *grad_alpha,
                          int left, int top, float2 *feed) {
    const int lane = threadIdx.x % BUCKET, plane = s.width * s.height;
    for (int p = lane; p < PIXELS; p += BUCKET) {
        const int u = left + p % TILE, v = top + p / TILE;
        const float T = state[p];
        float q = 0.0f;
        if (u < s.width && v < s.height) {
            const float *o = s.image + v * s.width + u;
            const float4 g = grad[p];
            q = g.x * (o[0] - state[PIXELS + p]) + g.y * (o[plane] - state[2 * PIXELS + p])
                + g.z * (o[2 * plane] - state[3 * PIXELS + p]) + g.w * (o[3 * plane] - state[4 * PIXELS + p])
                + grad_alpha[p] * (o[4 * plane] - (1.0f - fabsf(T)));
        }
        feed[p] = make_float2(T, q);
    }
    feed[PIXELS + lane] = make_float2(-1.0f, 0.0f);  // after the last pixel
    __syncwarp();
}

// Pixels walk through the lanes of a warp, one splat a lane, nearest first: lane 0 takes them from `feed`, each other
// lane from its neighbour. So the sums of a splat are those of one lane, and need no reduction. Lanes without a pixel
// have T = -1; lanes without a splat have an opacity of zero.
__device__ Moments walk(float4 r0, float4 r1, float4 r2, const float2 *feed, const float4 *grad,
                        const float *grad_alpha, int left, int top, int steps) {
    const int lane = threadIdx.x % BUCKET;
    Moments m = {0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0};
    float T = -1.0f, Q = 0.0f;
    int p = -lane;
    float px = (float)(left + (p & (TILE - 1))), py = (float)(top + (p >> TILE_SHIFT));
    for (int step = 0; step < steps; ++step) {
        T = __shfl_up_sync(FULL, T, 1);
        Q = __shfl_up_sync(FULL, Q, 1);
        if (lane == 0) { T = feed[step].x; Q = feed[step].y; }
        const float dx = px - r0.x, dy = py - r0.y;
        const float power = power_at(r0, r1.x, r1.y, dx, dy);
        if (power >= LOG2_ALPHA_MIN && T > 0.0f) {
            const float alpha = fminf(exp2f(power), ALPHA_MAX);
            const float w = __fmul_rn(T, alpha), after = __fsub_rn(T, w);
            T = after > MIN_TRANSMITTANCE ? after : -T;
            if (T > 0.0f) {
                const float4 g = grad[p];
                const float gain = w * (g.x * r1.z + g.y * r1.w + g.z * r2.x + g.w * r2.y + grad_alpha[p]);
                Q -= gain;
                const float v = alpha < ALPHA_MAX ? gain - Q * __fdividef(alpha, 1.0f - alpha) : 0.0f;
                const float a = v * dx, b = v * dy;
                m.v += v; m.x += a; m.y += b; m.xx += a * dx; m.xy += a * dy; m.yy += b * dy;
                m.r += w * g.x; m.g += w * g.y; m.b += w * g.z; m.z += w * g.w; m.w += w;
            }
        }
        ++p;
        px += 1.0f;
        if ((p & (TILE - 1)) == 0) { px -= (float)TILE; py += 1.0f; }
    }
    return m;
}

// One block a group of pairs of a tile, one warp a bucket, one lane a pair.
KERNEL(GROUP) backward(RasterArguments s) {
    __shared__ float4 grad[PIXELS];                            // dL/d(r, g, b, depth) of the tile's pixels
    __shared__ float grad_alpha[PIXELS];
    __shared__ float2 feed[GROUP / BUCKET][PIXELS + BUCKET];
    const int group = blockIdx.x, lane = threadIdx.x % BUCKET, warp = threadIdx.x / BUCKET;
    if (group >= min(s.group_start[s.tiles], s.groups)) return;
    const int tile = tile_of(s, group), into = (group - s.group_start[tile]) * GROUP;
    const int end = min(s.tile_start[tile + 1], s.pairs), used = s.tile_used[tile];
    const int k = s.tile_start[tile] + into + threadIdx.x, bucket = k - lane;
    const bool valid = k < end, occluded = into + warp * BUCKET >= used;
    const int pair = (int)s.sorted_pair[min(k, end - 1)];
    if (occluded && valid)  // the memory holds sums of an earlier image
        for (int j = 0; j < 3; ++j) s.slots[3 * pair + j] = make_float4(0, 0, 0, 0);
    if (into >= used) return;  // the whole block
    const int left = tile % s.tiles_x * TILE, top = tile / s.tiles_x * TILE, plane = s.width * s.height;
    for (int p = threadIdx.x; p < PIXELS; p += GROUP) {
        const int u = left + p % TILE, v = top + p / TILE;
        const bool inside = u < s.width && v < s.height;
        const float *g = s.gradient + (inside ? v * s.width + u : 0);
        grad[p] = inside ? make_float4(g[0], g[plane], g[2 * plane], g[3 * plane]) : make_float4(0, 0, 0, 0);
        grad_alpha[p] = inside ? g[4 * plane] : 0.0f;
    }
    __syncthreads();
    if (bucket >= end || occluded) return;  // the whole warp
    const float *state = s.states + ((long long)group * (GROUP / BUCKET) + warp) * CHANNELS * PIXELS;
    load_feed(s, state, grad, grad_alpha, left, top, feed[warp]);
    const float4 *record = s.records + 3 * s.pair_gaussian[pair];
    const float4 r0 = record[0], r2 = record[2];
    float4 r1 = record[1];
    if (!valid) r1.y = -1e30f;
    const int steps = PIXELS + min(BUCKET, end - bucket) - 1;
    const Moments m = walk(r0, r1, r2, feed[warp], grad, grad_alpha, left, top, steps);
    if (valid) {
        s.slots[3 * pair] = make_float4(m.v, m.x, m.y, m.xx);
        s.slots[3 * pair + 1] = make_float4(m.xy, m.yy, m.r, m.g);
        s.slots[3 * pair + 2] = make_float4(m.b, m.z, m.w, 0.0f);
    }
}
