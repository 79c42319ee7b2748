// Losses of the mapper and their gradients on the image, as `services/mapping/kernels.py` and `ssim.py`. Every kernel
// has blocks of 256 threads; sums are written per block and added by `finish_step`.
//
// Hidden pixels (on dynamic objects) have a gradient of zero; their target is the render itself, rounded to 8 bits.
#define BLOCK_W 16
#define RADIUS 5
#define HALO (BLOCK_W + 2 * RADIUS)
#define TO_UNIT (1.0f / 255.0f)

// The parts of a keyframe's targets, see `pack_targets`.
__device__ const unsigned short *depth_mm_of(const unsigned char *t) { return (const unsigned short *)t; }
__device__ const unsigned char *rgb_of(const unsigned char *t, int plane) { return t + 2 * plane; }
__device__ const unsigned char *weight_of(const unsigned char *t, int plane) { return t + 5 * plane; }
__device__ const unsigned char *hidden_of(const unsigned char *t, int plane) { return t + 6 * plane; }
__device__ const int *beams_of(const unsigned char *t, int plane) {
    return (const int *)(t + (7 * plane + 15) / 16 * 16);
}

// Colour of the target in [0, 1].
__device__ float target_of(const LossArguments &s, int channel, int i, int plane, bool hidden) {
    if (!hidden) return (float)rgb_of(s.targets, plane)[channel * plane + i] * TO_UNIT;
    const float shown = s.image[channel * plane + i] * s.tone[channel] + s.tone[3 + channel];
    return floorf(fminf(fmaxf(shown * 255.0f + 0.5f, 0.0f), 255.0f)) * TO_UNIT;
}

// Adds up a value over the block, in one order; thread 0 writes it to `out`. `room` has 8 places.
__device__ void block_sum(float value, float *out, float *room) {
    #pragma unroll
    for (int offset = 16; offset; offset >>= 1) value += __shfl_xor_sync(FULL, value, offset);
    if (threadIdx.x % 32 == 0) room[threadIdx.x / 32] = value;
    __syncthreads();
    if (threadIdx.x == 0) {
        float total = 0;
        for (int warp = 0; warp < 8; ++warp) total += room[warp];
        *out = total;
    }
    __syncthreads();
}

// One thread a pixel: L1 of colour after exposure, and weight * depth_scale * |D - d alpha|. Overwrites the gradient.
KERNEL(256) pixel_losses(LossArguments s) {
    __shared__ float room[8];
    const int i = blockIdx.x * 256 + threadIdx.x, plane = s.width * s.height;
    float colour = 0, depth = 0;
    if (i < plane) {
        const bool hidden = hidden_of(s.targets, plane)[i] != 0;
        #pragma unroll
        for (int c = 0; c < 3; ++c) {
            const float gain = s.tone[c];
            const float shown = s.image[c * plane + i] * gain + s.tone[3 + c];
            const float error = shown - target_of(s, c, i, plane, hidden);
            const float slope = error > 0.0f ? s.colour_scale : -s.colour_scale;
            s.gradient[c * plane + i] = hidden ? 0.0f : slope * gain;
            colour += fabsf(error);
        }
        const float d = (float)depth_mm_of(s.targets)[i] * 1e-3f;
        const float weight = d > 0.0f ? (float)weight_of(s.targets, plane)[i] * TO_UNIT * s.depth_scale : 0.0f;
        const float error = s.image[3 * plane + i] - d * s.image[4 * plane + i];
        const float slope = error > 0.0f ? weight : -weight;
        s.gradient[3 * plane + i] = hidden ? 0.0f : slope;
        s.gradient[4 * plane + i] = hidden ? 0.0f : -slope * d;
        depth = weight * fabsf(error);
    }
    block_sum(colour, s.pixel_parts + 2 * blockIdx.x, room);
    block_sum(depth, s.pixel_parts + 2 * blockIdx.x + 1, room);
}

// One thread a pixel with beams: scale * |D - z alpha| of all its beams, in their order.
KERNEL(256) beam_losses(LossArguments s) {
    __shared__ float room[8];
    const int plane = s.width * s.height;
    const int *head = beams_of(s.targets, plane), pixels = head[0], beams = head[1];
    const int *pixel = head + 4, *end = pixel + pixels;
    const float *z_m = (const float *)(end + pixels);
    const float scale = beams ? (float)((double)s.lidar_weight / beams) : 0.0f;
    float loss = 0;
    for (int k = blockIdx.x * 256 + threadIdx.x; k < pixels; k += gridDim.x * 256) {
        const int i = pixel[k];
        const float depth = s.image[3 * plane + i], alpha = s.image[4 * plane + i];
        float d_depth = s.gradient[3 * plane + i], d_alpha = s.gradient[4 * plane + i];
        for (int beam = k ? end[k - 1] : 0; beam < end[k]; ++beam) {
            const float error = depth - z_m[beam] * alpha, slope = error > 0.0f ? scale : -scale;
            d_depth += slope;
            d_alpha -= slope * z_m[beam];
            loss += fabsf(error) * scale;
        }
        if (!hidden_of(s.targets, plane)[i]) {
            s.gradient[3 * plane + i] = d_depth;
            s.gradient[4 * plane + i] = d_alpha;
        }
    }
    block_sum(loss, s.beam_parts + blockIdx.x, room);
}

// Luma of the render after exposure, and of the target.
__device__ float2 lumas(const LossArguments &s, int i, int plane) {
    const bool hidden = hidden_of(s.targets, plane)[i] != 0;
    const float luma[3] = {LUMA_R, LUMA_G, LUMA_B};
    float x = s.tone[9], y = 0;
    #pragma unroll
    for (int c = 0; c < 3; ++c) {
        x += s.tone[6 + c] * s.image[c * plane + i];
        y += luma[c] * target_of(s, c, i, plane, hidden);
    }
    return make_float2(x, y);
}

// SSIM from the blurred planes x, y, xx, yy, xy of a pixel, and its derivatives to the means of x, xx and xy.
__device__ float ssim_of(const float *m, float *d) {
    const float mx = m[0], my = m[1];
    const float a1 = 2 * mx * my + SSIM_C1, a2 = 2 * (m[4] - mx * my) + SSIM_C2;
    const float b1 = mx * mx + my * my + SSIM_C1, b2 = m[2] - mx * mx + m[3] - my * my + SSIM_C2;
    const float inverse = 1.0f / (b1 * b2), value = a1 * a2 * inverse;
    const float d_xy = 2 * a1 * inverse, d_xx = -value / b2;
    d[0] = 2 * my * a2 * inverse - 2 * mx * value / b1 - my * d_xy - 2 * mx * d_xx;
    d[1] = d_xx;
    d[2] = d_xy;
    return value;
}

// One block a square of 16 x 16 pixels: the sum of SSIM, and its derivatives. Outside the image, all is zero.
KERNEL(256) ssim_partials(LossArguments s) {
    __shared__ float2 xy[HALO][HALO];
    __shared__ float rows[5][HALO][BLOCK_W], room[8];
    const int across = (s.width + BLOCK_W - 1) / BLOCK_W, plane = s.width * s.height;
    const int x0 = blockIdx.x % across * BLOCK_W, y0 = blockIdx.x / across * BLOCK_W;
    for (int k = threadIdx.x; k < HALO * HALO; k += 256) {
        const int u = x0 + k % HALO - RADIUS, v = y0 + k / HALO - RADIUS;
        const bool inside = u >= 0 && v >= 0 && u < s.width && v < s.height;
        xy[k / HALO][k % HALO] = inside ? lumas(s, v * s.width + u, plane) : make_float2(0, 0);
    }
    __syncthreads();
    for (int k = threadIdx.x; k < HALO * BLOCK_W; k += 256) {
        const int r = k / BLOCK_W, c = k % BLOCK_W;
        float m[5] = {0};
        for (int t = 0; t < 2 * RADIUS + 1; ++t) {
            const float w = s.taps[t], x = xy[r][c + t].x, y = xy[r][c + t].y;
            m[0] += w * x; m[1] += w * y; m[2] += w * (x * x); m[3] += w * (y * y); m[4] += w * (x * y);
        }
        #pragma unroll
        for (int j = 0; j < 5; ++j) rows[j][r][c] = m[j];
    }
    __syncthreads();
    const int c = threadIdx.x % BLOCK_W, r = threadIdx.x / BLOCK_W, u = x0 + c, v = y0 + r;
    float value = 0;
    if (u < s.width && v < s.height) {
        float m[5] = {0}, d[3];
        for (int t = 0; t < 2 * RADIUS + 1; ++t)
            #pragma unroll
            for (int j = 0; j < 5; ++j) m[j] += s.taps[t] * rows[j][r + t][c];
        value = ssim_of(m, d);
        #pragma unroll
        for (int j = 0; j < 3; ++j) s.partials[j * plane + v * s.width + u] = d[j];
    }
    block_sum(value, s.ssim_parts + blockIdx.x, room);
}

// Adds ssim_scale * dSSIM/d(pixel) to the gradient of the colours.
KERNEL(256) ssim_gradient(LossArguments s) {
    __shared__ float p[3][HALO][HALO], rows[3][HALO][BLOCK_W];
    const int across = (s.width + BLOCK_W - 1) / BLOCK_W, plane = s.width * s.height;
    const int x0 = blockIdx.x % across * BLOCK_W, y0 = blockIdx.x / across * BLOCK_W;
    for (int k = threadIdx.x; k < HALO * HALO; k += 256) {
        const int u = x0 + k % HALO - RADIUS, v = y0 + k / HALO - RADIUS;
        const bool inside = u >= 0 && v >= 0 && u < s.width && v < s.height;
        #pragma unroll
        for (int j = 0; j < 3; ++j)
            p[j][k / HALO][k % HALO] = inside ? s.partials[j * plane + v * s.width + u] : 0.0f;
    }
    __syncthreads();
    for (int k = threadIdx.x; k < HALO * BLOCK_W; k += 256) {
        const int r = k / BLOCK_W, c = k % BLOCK_W;
        float m[3] = {0};
        for (int t = 0; t < 2 * RADIUS + 1; ++t)
            #pragma unroll
            for (int j = 0; j < 3; ++j) m[j] += s.taps[t] * p[j][r][c + t];
        #pragma unroll
        for (int j = 0; j < 3; ++j) rows[j][r][c] = m[j];
    }
    __syncthreads();
    const int c = threadIdx.x % BLOCK_W, r = threadIdx.x / BLOCK_W, u = x0 + c, v = y0 + r, i = v * s.width + u;
    if (u >= s.width || v >= s.height || hidden_of(s.targets, plane)[i]) return;
    float m[3] = {0};
    for (int t = 0; t < 2 * RADIUS + 1; ++t)
        #pragma unroll
        for (int j = 0; j < 3; ++j) m[j] += s.taps[t] * rows[j][r + t][c];
    const float2 xy = lumas(s, i, plane);
    const float g = (m[0] + 2 * xy.x * m[1] + xy.y * m[2]) * s.ssim_scale;
    #pragma unroll
    for (int k = 0; k < 3; ++k) s.gradient[k * plane + i] += s.tone[6 + k] * g;
}

// One thread a pixel, from the complete gradient: dL/d(log gain) = sum of colour * dL/d(colour), and
// dL/d(offset) = sum of dL/d(colour) / gain.
KERNEL(256) exposure_sums(LossArguments s) {
    __shared__ float room[8];
    const int i = blockIdx.x * 256 + threadIdx.x, plane = s.width * s.height;
    for (int c = 0; c < 3; ++c) {
        const float g = i < plane ? s.gradient[c * plane + i] : 0.0f;
        const float colour = i < plane ? s.image[c * plane + i] : 0.0f;
        block_sum(g * colour, s.exposure_parts + 6 * blockIdx.x + c, room);
        block_sum(g / s.tone[c], s.exposure_parts + 6 * blockIdx.x + 3 + c, room);
    }
}
