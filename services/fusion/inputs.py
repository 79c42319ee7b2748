"""Data of the plane sweep (method `field`): input frame, image at the working size, result, settings."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from beamsplat.common.geometry.beams import Beams
from beamsplat.services.fusion.keyframe_depth import KeyframeDepths, WarpedDepth
from beamsplat.services.fusion.scaling import Kind
from beamsplat.services.fusion.surfaces import CeilingDetector


@dataclass(frozen=True)
class PlaneSweepConfig:
    """Settings of the plane sweep. Weights are in units of the matching cost (at most `cost_scale`).

    The defaults are for a body that stays level on a floor, `in_hand()` for a hand-held sensor. Each set was
    tuned with `beamsplat eval depth` on one recording (`house_a`, `redkitchen`).
    """

    width_px: int = 160  # working size; the height follows from the aspect ratio
    labels: int = 64  # depth hypotheses, evenly spaced in log depth
    z_near_m: float = 0.4  # depth of the nearest hypothesis
    z_far_m: float = 14.0  # depth of the farthest hypothesis
    baselines_m: tuple[float, ...] = (0.2, 0.4, 0.8)  # preferred distances to the source images
    max_turn_rad: float = 0.6  # largest angle between the viewing directions of two images
    cost_scale: float = 12.0  # of the matching cost per unit of feature difference
    cost_cap: float = 5.0  # truncation: one very bad match must not outweigh the smoothness terms
    p1: float = 0.7  # penalty for a change of one label (Hirschmueller 2008)
    p2: float = 20.0  # penalty for a change of several labels
    edge_grey: float = 30.0  # grey step at which p2 is halved
    temperature: float = 4.0  # of the label distribution exp(-cost / temperature)
    wall_near: float = 4.0  # prior weight of the extruded beams at the height of the lidar
    wall_far: float = 0.15  # weight of these beams far above and below, for a body that stays level
    wall_reach_m: float = 0.15  # e-folding height of `wall_near`
    floor: float = 4.0  # prior weight of the floor plane
    occluded_walls: float = 0.5  # prior weight of each wall behind the nearest one
    ceiling: float = 3.5  # prior weight of a detected ceiling plane
    ceiling_evidence: float = 500.0  # least evidence of a ceiling plane
    keyframe_depth: float = 0.5  # prior weight of depth warped from past keyframes
    keyframes_kept: int = 6  # past keyframes whose depth is kept
    keyframe_max_spread: float = 0.12  # pixels with a larger spread of log depth are not kept
    min_override_votes: int = 0  # keyframes that replace the depth of a single sweep; 0 = never
    per_spread: float = 1.0  # sigma of log depth per unit of the label spread
    matched: float = 0.07  # sigma of log depth where image matching is the only evidence
    max_sigma_log: float = 0.3  # pixels with a larger sigma of log depth are unknown
    max_sigma_m: float = 0.95  # pixels whose neighbourhood has a larger mean sigma are unknown
    estimate: float = 1.6  # prior weight of the depth source's estimate
    estimate_spread: float = 0.12  # spread of log depth at which the weight `estimate` falls to 1/e
    near_m: float = 0.7  # depth below this is penalised
    near: float = 1.0  # penalty per unit of log depth below `near_m`
    rotation_sigma_rad: float = 0.007  # rotation error of a relative pose from localization
    translation_sigma_m: float = 0.015  # translation error of a relative pose from localization

    @staticmethod
    def in_hand() -> PlaneSweepConfig:
        """Return settings for hand-held sensors: no floor plane, inclined walls, keyframes can outvote."""
        return PlaneSweepConfig(
            labels=88, baselines_m=(0.1, 0.2, 0.4, 0.8),
            cost_cap=np.inf, p2=12.0, edge_grey=12.0, temperature=2.0, keyframe_depth=1.5,
            keyframe_max_spread=0.15,
            min_override_votes=3, per_spread=2.3, matched=0.05, max_sigma_log=0.19, max_sigma_m=np.inf,
        )  # fmt: skip


@dataclass(frozen=True)
class FusionInput:
    """One undistorted image with the robot's pose, the beams and the depth estimate at the image time."""

    stamp_ns: int
    image_rgb: np.ndarray  # uint8 [H, W, 3]
    T_map_body: np.ndarray
    beams: Beams
    estimate: np.ndarray | None = None  # float32 [H, W]; unit by `estimate_kind`
    estimate_kind: Kind = "none"


@dataclass(frozen=True)
class WorkingImage:
    """An image at the working size [h, w], with the features for matching and the camera pose."""

    T_map_camera: np.ndarray
    grey: np.ndarray  # float32 [h, w]
    features: np.ndarray  # float32 [h, w, 3]
    grey_2x: np.ndarray  # uint8 [2h, 2w], for corner tracking


@dataclass(frozen=True)
class SweepResult:
    """Depth map of one image at the working size [h, w], with its uncertainty."""

    depth_m: np.ndarray  # float32 [h, w]
    spread: np.ndarray  # float32 [h, w]: standard deviation of log depth over the label distribution
    snapped: np.ndarray  # bool [h, w]: depth set to a candidate surface (beams, floor, ceiling)
    views: int  # source images of the sweep


@dataclass(frozen=True)
class KeyframeTask:
    """The sweep of one keyframe, with copies of all state that the sweep changes."""

    frame: FusionInput
    working: WorkingImage
    views: list[WorkingImage]  # source images
    warped: WarpedDepth | None  # `depths` in the view of `working`; None = not computed yet
    depths: KeyframeDepths
    ceilings: CeilingDetector


def features(grey: np.ndarray, side: int = 9, floor_grey: float = 3.0) -> np.ndarray:
    """Return features float32 [h, w, 3]: grey value and gradient, normalised by the local contrast.

    They do not depend on exposure and gain.
    """
    mean = cv2.boxFilter(grey, -1, (side, side))
    contrast = (
        np.sqrt(np.maximum(cv2.boxFilter(grey * grey, -1, (side, side)) - mean * mean, 0.0)) + floor_grey
    )
    dx = cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
    dy = cv2.Sobel(grey, cv2.CV_32F, 0, 1, ksize=3, scale=0.125)
    return np.stack([(grey - mean) / contrast, dx / contrast, dy / contrast], axis=-1)
