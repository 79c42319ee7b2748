"""What `field` works on: an image with its pose, its small version, what was solved, and the weights."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from beamsplat.common.geometry.beams import Beams


@dataclass(frozen=True)
class PlaneSweepConfig:
    """Weights are in units of the matching cost, whose worst value is `cost_scale`.

    The defaults are for a body on a floor, `in_hand()` for one that tilts: measured on one drive of each.
    """

    width_px: int = 160  # working size; the height follows
    labels: int = 64
    z_near_m: float = 0.4
    z_far_m: float = 14.0
    baselines_m: tuple[float, ...] = (0.2, 0.4, 0.8)
    max_turn_rad: float = 0.6
    cost_scale: float = 12.0
    cost_cap: float = 5.0  # beyond it a label is simply wrong: how wrong must not outvote the neighbours
    p1: float = 0.7
    p2: float = 20.0
    edge_grey: float = 30.0
    temperature: float = 4.0
    wall_near: float = 4.0  # at the height of the lidar
    wall_far: float = 0.15  # far above and below, on a body that stays level
    wall_reach_m: float = 0.15
    floor: float = 4.0
    occluded_walls: float = 0.5
    ceiling: float = 3.5
    ceiling_evidence: float = 500.0
    memory: float = 0.5
    memory_keyframes: int = 6
    memory_spread: float = 0.12
    outvote: int = 0  # keyframes that overrule a sweep; 0 = never
    per_spread: float = 1.0  # error per unit of the matcher's own spread
    matched: float = 0.07  # standard deviation of log depth that only images tell
    tell_log: float = 0.3  # sigma of log depth, and sigma about a pixel in metres, beyond which there
    tell_m: float = 0.95  # is no answer
    estimate: float = 1.6
    estimate_spread: float = 0.12
    near_m: float = 0.7  # unsupported depth below this is unlikely
    near: float = 1.0
    rotation_sigma_rad: float = 0.007
    translation_sigma_m: float = 0.015

    @staticmethod
    def in_hand() -> PlaneSweepConfig:
        """No floor and no upright walls to lean on: what several keyframes agree on counts instead."""
        return PlaneSweepConfig(
            labels=88, baselines_m=(0.1, 0.2, 0.4, 0.8),
            cost_cap=np.inf, p2=12.0, edge_grey=12.0, temperature=2.0, memory=1.5, memory_spread=0.15,
            outvote=3, per_spread=2.3, matched=0.05, tell_log=0.19, tell_m=np.inf,
        )  # fmt: skip


@dataclass(frozen=True)
class FusionInput:
    """One undistorted image with its pose, beams and the estimate of a depth source."""

    stamp_ns: int
    image_rgb: np.ndarray  # uint8 [H, W, 3]
    T_map_body: np.ndarray
    beams: Beams
    estimate: np.ndarray | None = None  # float32 [H, W]
    estimate_kind: str = "none"


@dataclass(frozen=True)
class WorkingImage:
    """An image at the working size."""

    T_map_camera: np.ndarray
    grey: np.ndarray  # float32 [h, w]
    features: np.ndarray  # float32 [h, w, 3]
    middle: np.ndarray  # uint8 [2h, 2w]: corners are tracked here


@dataclass(frozen=True)
class SweepResult:
    """Depth at the working size."""

    depth_m: np.ndarray  # float32 [h, w]
    spread: np.ndarray  # float32 [h, w]: standard deviation of log depth, as the method believes
    snapped: np.ndarray  # bool [h, w]: depth taken from a surface that beams or floor predict
    views: int  # images swept over


def features(grey: np.ndarray, side: int = 9, floor_grey: float = 3.0) -> np.ndarray:
    """float32 [h, w, 3]: grey and its gradient, by the contrast around: blind to check_exposure and gain."""
    mean = cv2.boxFilter(grey, -1, (side, side))
    contrast = (
        np.sqrt(np.maximum(cv2.boxFilter(grey * grey, -1, (side, side)) - mean * mean, 0.0)) + floor_grey
    )
    dx = cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
    dy = cv2.Sobel(grey, cv2.CV_32F, 0, 1, ksize=3, scale=0.125)
    return np.stack([(grey - mean) / contrast, dx / contrast, dy / contrast], axis=-1)
