"""What can be chosen about camera tracking. Work is fixed per picture: nothing depends on the time of day."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CameraTrackerSettings:
    """Lengths in the map's unit (metres, where the depth is metric), colours in [0, 1]."""

    planar: bool = True  # the body stays level on a floor: three degrees of freedom instead of six
    width_px: int = 320  # of the finest level; pictures are made smaller, never larger
    # Alignment: Gauss-Newton steps per level, coarse to fine; each level halves the size.
    coarse_steps: tuple[int, ...] = (8, 8)  # at a quarter and at half of the finest size
    fine_steps: int = 6
    exact_steps: int = 0  # further steps down the rasterizer's own pose gradient
    least_gradient: float = 0.012  # grey levels a pixel; flatter pixels say nothing of motion
    least_alpha: float = 0.6  # less than this and the map does not explain the pixel
    most_points: int = 12_000
    # Is the answer to be believed?
    least_points: int = 150
    least_inliers: float = 0.6  # share of points within `inlier_error`
    least_correlation: float = 0.6
    inlier_error: float = 0.10
    least_contrast: float = 0.02  # standard deviation of the picture's grey: below, it shows nothing
    max_step_m: float = 0.5  # between pictures, beyond the prediction
    max_step_rad: float = 0.5
    restart_after: int = 15  # pictures without an answer, then the map goes on from the last pose
    # Keyframes
    least_covisibility: float = 0.80  # intersection over union of Gaussians in view with the last keyframe's
    least_explained: float = 0.93  # share of the picture where the map is opaque
    # The map
    stride_px: int = 4
    fine_stride_px: int = 2
    texture: float = 0.12  # mean absolute colour step (Sobel sums) that gets the fine stride
    alpha_low: float = 0.6
    colour_off: float = 0.12
    depth_off: float = 0.10
    float_margin: float = 0.08  # relative, beyond which a Gaussian floats before the surface
    coarse_px: float = 6.0  # standard deviation in a keyframe beyond which a Gaussian is too coarse for it
    least_depth_weight: float = 0.5  # below, a depth is no reason to remove anything that floats
    size: float = 0.45  # standard deviation over spacing
    flatness: float = 0.2
    opacity: float = 0.95
    prune_opacity: float = 0.05
    max_gaussians: int = 200_000
    window: int = 6  # newest keyframes, of which every second optimisation step takes one
    steps_per_picture: int = 2
    first_steps: int = 8  # on the first keyframe: the robot drives on meanwhile
    depth_weight: float = 0.2
    mean_rate_m: float = 2e-4
    log_scale_rate: float = 3e-3
    quat_rate: float = 1e-3
    opacity_rate: float = 2e-2
    colour_rate: float = 1e-2
