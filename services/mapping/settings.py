"""What can be chosen about the mapper. All work is fixed per keyframe: nothing depends on the time of day."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class LearningRates:
    """Adam's step per parameter, in the parameter's own unit."""

    mean_m: float = 2e-3  # of keyframes just taken in: Gaussians have to find their places
    refined_mean_m: float = 6e-4  # of refinement: places are known, and jitter shows
    log_scale: float = 6e-3
    quat: float = 2e-3
    opacity_logit: float = 3e-2
    colour: float = 5e-3
    pose_rad: float = 2e-4
    pose_m: float = 2e-4
    exposure: float = 1e-3


@dataclass(frozen=True)
class MapperSettings:
    """See module. Lengths in metres, sizes in pixels of the full picture."""

    # Work per keyframe; sizes are halved once for `half` iterations.
    half_iterations: int = 18
    full_iterations: int = 5
    recent: int = 8  # keyframes of the window that are newest; each second draw is one of them
    # Insertion
    stride_px: int = 5
    fine_stride_px: int = 3  # where the picture has texture
    texture: float = 0.15  # mean absolute colour step over `stride_px` that counts as texture
    sure_weight: float = 0.25  # depth of less weight is not put where other keyframes see through
    alpha_low: float = 0.7  # less than this is not explained
    colour_off: float = 0.15  # mean absolute colour error that is not explained
    depth_off: float = 0.10  # relative depth error that is not explained
    opacity: float = 0.6
    size: float = 0.65  # standard deviation over spacing
    flatness: float = 0.2
    least_slant: float = 0.12  # cosine to the normal that bounds how long a disc gets down a slope
    max_gaussians: int = 300_000
    max_keyframes: int = 800  # 2.2 MB each at 640x480; beyond it old ones are forgotten, drawn by chance
    # Losses
    ssim_weight: float = 0.2
    ssim_every: int = 3
    depth_weight: float = 0.15
    lidar_weight: float = 1e-3
    isotropy_weight: float = 0.05
    isotropy_ratio: float = 12.0
    sigma_unit: float = 0.03  # a depth whose sigma is this share of it has weight 1/2
    # Upkeep
    prune_opacity: float = 0.03
    carve_sigma: float = 3.0
    carve_weight: float = 0.5  # of depth that can carve
    carve_margin: float = 0.08  # relative, beyond which a Gaussian floats before a trusted surface
    carve_strikes: int = 2
    refine_pose: bool = False
    refine_exposure: bool = False
    max_pose_m: float = 0.10
    max_pose_rad: float = 0.05
    rates: LearningRates = field(default_factory=LearningRates)
