"""Settings of camera tracking. The work per image is fixed and does not depend on wall-clock time."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CameraTrackerSettings:
    """Settings of camera tracking: lengths in the unit of the map (metres if metric), colours in [0, 1]."""

    planar: bool = True  # the body stays level on a floor: three degrees of freedom instead of six
    width_px: int = 320  # of the finest level; images are only reduced, never enlarged
    # Alignment: Gauss-Newton steps per level, coarse to fine; each level halves the size.
    coarse_steps: tuple[int, ...] = (8, 8)  # at a quarter and at half of the finest size
    fine_steps: int = 6
    rasterizer_steps: int = 0  # further steps along the rasterizer's own pose gradient
    min_gradient: float = 0.012  # grey (0..1) per pixel; flatter pixels do not constrain the motion
    min_alpha: float = 0.6  # with a lower opacity the map does not cover the pixel
    max_points: int = 12_000
    # Acceptance of an alignment
    min_points: int = 150
    min_inlier_ratio: float = 0.6  # fraction of points with an error below `inlier_error`
    min_correlation: float = 0.6
    inlier_error: float = 0.10
    min_contrast: float = 0.02  # standard deviation of grey, below which an image is rejected as blank
    max_step_m: float = 0.5  # largest deviation from the predicted pose
    max_step_rad: float = 0.5
    restart_after: int = 15  # consecutive failures, after which mapping continues at the last pose
    # Keyframes
    min_covisibility: float = 0.80  # intersection over union of Gaussians in view with the last keyframe's
    min_coverage: float = 0.93  # fraction of the image where the map is opaque
    # Map
    stride_px: int = 4  # spacing of new Gaussians
    fine_stride_px: int = 2
    texture: float = 0.12  # mean absolute colour step (Sobel sums) above which the fine stride is used
    alpha_low: float = 0.6  # opacity below which new Gaussians are added
    max_colour_error: float = 0.12  # mean absolute difference to the keyframe
    max_depth_error: float = 0.10  # relative to the keyframe's depth
    float_margin: float = 0.08  # relative distance before the surface, beyond which a Gaussian is removed
    coarse_px: float = 6.0  # projected standard deviation, beyond which a Gaussian is replaced by finer ones
    min_depth_weight: float = 0.5  # depths with a lower weight do not cause removals
    size: float = 0.45  # standard deviation of a new Gaussian relative to the spacing
    flatness: float = 0.2
    opacity: float = 0.95
    prune_opacity: float = 0.05
    max_gaussians: int = 200_000
    max_keyframes: int = 200  # 1.5 MB each at 320 x 240
    window: int = 6  # number of newest keyframes; every second optimisation step uses one of them
    steps_per_image: int = 2
    first_steps: int = 8  # on the first keyframe; few, because the robot keeps moving meanwhile
    depth_weight: float = 0.2
    mean_rate_m: float = 2e-4
    log_scale_rate: float = 3e-3
    quat_rate: float = 1e-3
    opacity_rate: float = 2e-2
    colour_rate: float = 1e-2
