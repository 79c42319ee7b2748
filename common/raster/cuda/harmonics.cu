// Colours that depend on the viewing direction, see `common.harmonics`: evaluation, gradient and Adam.

// The unit vector from the camera to Gaussian i in the map frame; returns 1 / distance (1/m).
__device__ float direction_to(const RasterArguments &s, int i, float *d) {
    const float *c = s.camera;  // R by rows, t: the camera is at -R^T t
    float square = 0;
    #pragma unroll
    for (int a = 0; a < 3; ++a) {
        d[a] = s.params[a * s.stride + i] + c[a] * c[9] + c[3 + a] * c[10] + c[6 + a] * c[11];
        square += d[a] * d[a];
    }
    const float inverse = 1.0f / fmaxf(sqrtf(square), 1e-9f);
    #pragma unroll
    for (int a = 0; a < 3; ++a) d[a] *= inverse;
    return inverse;
}

// Calls f(k, value, d value / d x, ... y, ... z) for each of the first `terms` functions at a unit vector.
template <class F> __device__ void for_each_harmonic(int terms, float x, float y, float z, F f) {
    const float xx = x * x, yy = y * y, zz = z * z;
    f(0, -SH_1 * y, 0.0f, -SH_1, 0.0f);
    f(1, SH_1 * z, 0.0f, 0.0f, SH_1);
    f(2, -SH_1 * x, -SH_1, 0.0f, 0.0f);
    if (terms == 3) return;
    f(3, SH_20 * x * y, SH_20 * y, SH_20 * x, 0.0f);
    f(4, SH_21 * y * z, 0.0f, SH_21 * z, SH_21 * y);
    f(5, SH_22 * (2 * zz - xx - yy), -2 * SH_22 * x, -2 * SH_22 * y, 4 * SH_22 * z);
    f(6, SH_23 * x * z, SH_23 * z, 0.0f, SH_23 * x);
    f(7, SH_24 * (xx - yy), 2 * SH_24 * x, -2 * SH_24 * y, 0.0f);
    if (terms == 8) return;
    f(8, SH_30 * y * (3 * xx - yy), 6 * SH_30 * x * y, 3 * SH_30 * (xx - yy), 0.0f);
    f(9, SH_31 * x * y * z, SH_31 * y * z, SH_31 * x * z, SH_31 * x * y);
    f(10, SH_32 * y * (4 * zz - xx - yy), -2 * SH_32 * x * y, SH_32 * (4 * zz - xx - 3 * yy), 8 * SH_32 * y * z);
    f(11, SH_33 * z * (2 * zz - 3 * xx - 3 * yy), -6 * SH_33 * x * z, -6 * SH_33 * y * z,
      SH_33 * (6 * zz - 3 * xx - 3 * yy));
    f(12, SH_34 * x * (4 * zz - xx - yy), SH_34 * (4 * zz - 3 * xx - yy), -2 * SH_34 * x * y, 8 * SH_34 * x * z);
    f(13, SH_35 * z * (xx - yy), 2 * SH_35 * x * z, -2 * SH_35 * y * z, SH_35 * (xx - yy));
    f(14, SH_36 * x * (xx - 3 * yy), 3 * SH_36 * (xx - yy), -6 * SH_36 * x * y, 0.0f);
}

// One thread a Gaussian: its colour as the camera sees it.
KERNEL(256) shade(RasterArguments s) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x, n = s.stride, terms = s.harmonic_terms;
    if (i >= *s.count) return;
    float d[3], colour[3];
    direction_to(s, i, d);
    #pragma unroll
    for (int c = 0; c < 3; ++c) colour[c] = s.params[(COLOUR + c) * n + i];
    const float *rows = s.harmonics + i;
    for_each_harmonic(terms, d[0], d[1], d[2], [&](int k, float value, float, float, float) {
        #pragma unroll
        for (int c = 0; c < 3; ++c) colour[c] += rows[(long long)(c * terms + k) * n] * value;
    });
    #pragma unroll
    for (int c = 0; c < 3; ++c) s.shown[c * n + i] = colour[c];
}

// One thread a Gaussian, before `chain`: the gradient of its centre through the direction, and Adam on its harmonics.
KERNEL(256) shade_backward(RasterArguments s) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x, n = s.stride, terms = s.harmonic_terms;
    if (i >= n) return;
    float turned[3] = {0, 0, 0};
    const int pairs = i < *s.count ? s.pair_count[i] : 0;
    if (pairs) {
        const int at = s.first_pair[i];
        const Moments m = sum_slots(s, at, min(at + pairs, s.pairs));
        if (m.w > 0.0f) {
            const float seen[3] = {m.r, m.g, m.b}, t = s.steps[i] + 1.0f, rate = s.rates[PARAMS + 2];
            const float fix_1 = -1.0f / expm1f(t * LN_BETA_1), fix_2 = -1.0f / expm1f(t * LN_BETA_2);
            float d[3], along[3] = {0, 0, 0};
            const float inverse = direction_to(s, i, d);
            for_each_harmonic(terms, d[0], d[1], d[2], [&](int k, float value, float dx, float dy, float dz) {
                #pragma unroll
                for (int c = 0; c < 3; ++c) {
                    const long long place = (long long)(c * terms + k) * n + i;
                    const float weight = seen[c] * s.harmonics[place], g = seen[c] * value;
                    along[0] += weight * dx; along[1] += weight * dy; along[2] += weight * dz;
                    if (!s.learn) continue;
                    const float first = s.harmonics_first[place] + (g - s.harmonics_first[place]) * ADAM_1;
                    const float second = s.harmonics_second[place] + (g * g - s.harmonics_second[place]) * ADAM_2;
                    s.harmonics_first[place] = first;
                    s.harmonics_second[place] = second;
                    s.harmonics[place] -= first * fix_1 / (sqrtf(second * fix_2) + EPSILON) * rate;
                }
            });
            // d = r / |r|: dd/dr = (I - d d^T) / |r|.
            const float radial = along[0] * d[0] + along[1] * d[1] + along[2] * d[2];
            #pragma unroll
            for (int a = 0; a < 3; ++a) turned[a] = (along[a] - radial * d[a]) * inverse;
        }
    }
    #pragma unroll
    for (int a = 0; a < 3; ++a) s.turned[a * n + i] = turned[a];
}
