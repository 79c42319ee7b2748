"""Layout of the rasterizer's arrays, and the rendering constants that all backends share.

Parameters are stored by component, float32 [PARAMS, capacity], so that a SIMD vector holds one component of
consecutive Gaussians. The semantics are those of 3DGS (Kerbl et al. 2023) with gsplat's constants: 0.3 px^2
is added to the image covariance, alpha is at most 0.999, alpha below 1/255 is skipped, and a pixel ends
before its transmittance would fall to 1e-4.
"""

from __future__ import annotations

import math

from beamsplat.common.raster.simd import LANES

MEAN, SCALE, QUAT, OPACITY, COLOUR = 0, 3, 6, 10, 11  # first row of each parameter
PARAMS = 14  # mean_map_m 3, log scale (ln m) 3, quat_wxyz 4, opacity logit 1, colour rgb 3
GROUPS = {
    "mean": (0, 3),
    "log_scale": (3, 6),
    "quat_wxyz": (6, 10),
    "opacity_logit": (10, 11),
    "colour": (11, 14),
}

# Additional rows of the gradient: |dL/d(centre in px)|, and the sum of the blending weights over all pixels.
SCREEN_GRADIENT, WEIGHT = 14, 15
GRADIENTS = 16

CHANNELS = 5  # planes of a rendered image: red, green, blue, accumulated depth (m), alpha

# Constants of gsplat, see above; the near plane NEAR_M (m) is our own choice.
BLUR_PX2 = 0.3
ALPHA_MAX = 0.999
ALPHA_MIN = 1.0 / 255.0
MIN_TRANSMITTANCE = 1e-4
NEAR_M = 0.05
LOG2_ALPHA_MIN = math.log2(ALPHA_MIN)
LOG2_ALPHA_MAX = math.log2(ALPHA_MAX)

TILE_W, TILE_H = 8, 32  # pixels
TILE_PIXELS = TILE_W * TILE_H
ROWS = LANES // TILE_W  # image rows in one vector
RECORD = 16  # floats per projected splat: x y A B C log2(opacity) r g b z, and six values for binning
SLOT = 16  # floats, a cache line: sums of one (splat, tile) pair: v vx vy vxx | vxy vyy wr wg | wb wz w | -
BATCHES = 16  # splats are processed in so many batches, independent of the number of threads: same results
