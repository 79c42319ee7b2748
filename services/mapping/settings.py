"""Settings of the mapper. The work per keyframe is fixed: nothing depends on the wall clock.

Values without another source were tuned with `beamsplat bench map`.
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class LearningRates:
    """Step sizes of Adam for each kind of parameter, in the unit of the parameter."""

    mean_m: float = 2e-3  # of the centre, for keyframes just inserted: new Gaussians are still displaced
    refined_mean_m: float = 6e-4  # of the centre, for refinement: larger steps make it jitter
    log_scale: float = 6e-3  # of the logarithm of the three standard deviations
    quat: float = 2e-3  # of the rotation as a unit quaternion
    opacity_logit: float = 3e-2  # of the logit of the opacity
    colour: float = 5e-3  # of the RGB colour in [0, 1]
    harmonics: float = 2.5e-4  # of coefficients of spherical harmonics: 1/20 of `colour`, as in 3DGS
    pose_rad: float = 2e-4  # of a keyframe's rotation, with `refine_pose`
    pose_m: float = 2e-4  # of a keyframe's position, with `refine_pose`
    exposure: float = 1e-3  # of a keyframe's exposure, with `refine_exposure`


@dataclass(frozen=True)
class MapperSettings:
    """Settings of insertion, losses and pruning; lengths in m, or in px of the full-size image."""

    # Work per keyframe; `half` iterations use the half-size image.
    half_iterations: int = 18  # per keyframe, at half size
    full_iterations: int = 5  # per keyframe, at full size
    recent: int = 8  # newest keyframes in the optimisation window; every second draw is one of them
    # Insertion
    stride_px: int = 5  # distance between new Gaussians
    fine_stride_px: int = 3  # distance between new Gaussians where the image has texture
    texture: float = 0.15  # mean absolute colour step over `stride_px` that counts as texture
    sure_weight: float = 0.25  # depth of lower weight is not inserted in observed free space
    min_alpha: float = 0.7  # a pixel with less is unexplained
    max_colour_error: float = 0.15  # mean absolute error in [0, 1]; a pixel with more is unexplained
    max_depth_error: float = 0.10  # relative; a pixel with more is unexplained
    opacity: float = 0.6  # opacity of a new Gaussian
    size: float = 0.65  # standard deviation of a new Gaussian over the spacing
    flatness: float = 0.2  # thickness of a new Gaussian over its size
    least_slant: float = 0.12  # lower bound of cos(angle to the normal): limits the length of discs on slopes
    max_gaussians: int = 300_000  # in memory and on disk together
    max_keyframes: int = 800  # 2.2 MB each at 640x480; beyond it, keyframes of crowded places are dropped
    # Losses
    ssim_weight: float = 0.2  # weight of the SSIM term; the L1 term of colour has the rest
    ssim_every: int = 3  # every so many steps, the loss contains the SSIM term
    depth_weight: float = 0.15  # weight of the depth loss
    lidar_weight: float = 1e-3  # weight of the loss at the beams
    isotropy_weight: float = 0.05  # weight of the loss of needle-shaped Gaussians
    isotropy_ratio: float = 12.0  # longest over second axis, above which the isotropy term acts
    sigma_unit: float = 0.03  # relative depth sigma that gets weight 1/2
    # Pruning
    prune_opacity: float = 0.03  # below it a Gaussian is removed
    carve_weight: float = 0.5  # least weight of a depth that can vote for carving
    carve_margin: float = 0.08  # relative distance to a surface from which a Gaussian is floating
    carve_votes: int = 2  # votes at which a floating Gaussian is removed
    refine_pose: bool = False
    refine_exposure: bool = False
    max_pose_m: float = 0.10  # largest correction of a keyframe's pose
    max_pose_rad: float = 0.05  # largest rotation by which a keyframe's pose is corrected
    rates: LearningRates = field(default_factory=LearningRates)
