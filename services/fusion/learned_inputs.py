"""Inputs of the learned aggregation, the same in training and in operation."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from beamsplat.services.fusion.aggregation import SweepEvidence
from beamsplat.services.fusion.learned_kernels import fill_features, quantised_energy
from beamsplat.services.fusion.surfaces import CandidateSurfaces

INPUTS_VERSION = 1  # raised when the meaning of a channel changes; part of the metadata of a weights file
LABELS = 64
# Candidate surfaces, in the order of their channels.
CANDIDATES = (
    "wall", "background wall", "floor", "first occluded wall", "second occluded wall", "ceiling",
    "past keyframes", "depth source",
)  # fmt: skip
SCALARS = 10
CHANNELS = 2 * LABELS + 3 * len(CANDIDATES) + SCALARS
MULTIPLE = 16  # sides of the network input: the network halves them four times
OUTPUTS = LABELS + len(CANDIDATES) + 2

_NEAR_M, _WIDE_M = 0.15, 0.6  # e-folding distances from the lidar plane
_MOST_VOTES, _MOST_VIEWS = 4, 4


@dataclass(frozen=True)
class AggregatorInputs:
    """Network inputs of one image of size [h, w], in the compact form in which training data are stored."""

    cost: np.ndarray  # uint8 [h, w, LABELS], quantised matching cost
    energy: np.ndarray  # uint8 [h, w, LABELS], quantised energy of semi-global matching
    log_depth: np.ndarray  # float16 [len(CANDIDATES), h, w], natural log of metres, NaN = none
    rgb: np.ndarray  # uint8 [h, w, 3]
    lidar_plane_m: np.ndarray  # float16 [h, w], distance of the extruded beam's point from the lidar plane
    votes: np.ndarray  # uint8 [h, w], past keyframes that agree on the warped depth
    rise: np.ndarray  # float16 [h, w], upward part of the rays, 0 if unknown
    spread: np.ndarray  # float16 [h, w], spread of semi-global matching (log depth)
    views: int  # source images of the sweep
    trust: float  # of the estimate of the depth source, in [0, 1]

    def place(self, log_z: np.ndarray) -> np.ndarray:
        """Return the label of each candidate surface, with its fraction, float32 [K, h, w]; NaN = none.

        `log_z` float64 [LABELS] is the log depth of the labels. Surfaces more than half a label outside are
        none.
        """
        at = (self.log_depth.astype(np.float32) - np.float32(log_z[0])) / np.float32(log_z[1] - log_z[0])
        last = len(log_z) - 1
        with np.errstate(invalid="ignore"):
            outside = ~((at > -0.5) & (at < last + 0.5))
        at = np.clip(at, 0.0, last)
        at[outside] = np.nan
        return at

    def scalars(self) -> np.ndarray:
        """Return the channels without labels and candidates, float32 [SCALARS, h, w]."""
        h, w = self.votes.shape
        out = np.empty((SCALARS, h, w), np.float32)
        out[0:3] = self.rgb.transpose(2, 0, 1) * np.float32(1.0 / 255.0)
        offset = self.lidar_plane_m.astype(np.float32)
        out[3], out[4] = np.exp(-offset / _NEAR_M), np.exp(-offset / _WIDE_M)
        out[5] = np.minimum(self.votes, _MOST_VOTES) * np.float32(1.0 / _MOST_VOTES)
        out[6] = self.rise
        out[7] = 2.0 * np.minimum(self.spread.astype(np.float32), 1.0)
        out[8] = min(self.views, _MOST_VIEWS) / _MOST_VIEWS
        out[9] = self.trust
        return out

    def features(self, log_z: np.ndarray) -> np.ndarray:
        """Return the network input float32 [CHANNELS, H, W]; `log_z` as in `place`.

        H and W are h and w rounded up to multiples of `MULTIPLE`; the pixels beyond h and w are 0.
        """
        H, W = (-(-side // MULTIPLE) * MULTIPLE for side in self.votes.shape)
        out = np.zeros((CHANNELS, H, W), np.float32)
        fill_features(self.cost, self.energy, self.place(log_z), self.scalars(), out)
        return out


def inputs_of(
    evidence: SweepEvidence,
    total: np.ndarray,  # float32 [h, w, LABELS], costs after semi-global matching
    spread: np.ndarray,  # float32 [h, w], spread of semi-global matching
    temperature: float,
) -> AggregatorInputs:
    """Return the network inputs of one keyframe; `evidence.matching_cost` is required."""
    assert evidence.matching_cost is not None
    h, w = spread.shape
    warped, offset_m = evidence.warped, evidence.surfaces.wall_offset_m
    return AggregatorInputs(
        cost=evidence.matching_cost, energy=quantised_energy(total, temperature),
        log_depth=_log_candidates(evidence),
        rgb=cv2.resize(evidence.image_rgb, (w, h), interpolation=cv2.INTER_AREA),
        lidar_plane_m=np.nan_to_num(offset_m, nan=9.0).clip(0.0, 9.0).astype(np.float16),
        votes=np.zeros((h, w), np.uint8) if warped is None else warped.votes.astype(np.uint8),
        rise=evidence.rise.astype(np.float16), spread=spread.astype(np.float16), views=evidence.views,
        trust=evidence.estimate_trust,
    )  # fmt: skip


def _log_candidates(evidence: SweepEvidence) -> np.ndarray:
    """Return the log depth of all candidate surfaces, float16 [len(CANDIDATES), h, w], NaN = none."""
    surfaces = evidence.surfaces
    on_floor = surfaces.on_floor
    none = np.full(on_floor.shape, np.nan)
    candidates = [
        np.where(on_floor, np.nan, surfaces.wall), np.where(on_floor, np.nan, surfaces.background_wall),
        surfaces.floor, *_nearest_occluded(surfaces, none), _nearest_ceiling(surfaces, none),
        none if evidence.warped is None else evidence.warped.depth_m,
        none if evidence.estimate_m is None else evidence.estimate_m,
    ]  # fmt: skip
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.log(np.stack(candidates)).astype(np.float16)


def _nearest_occluded(surfaces: CandidateSurfaces, none: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the two nearest occluded walls of each pixel, [h, w] each."""
    if not surfaces.occluded_walls:
        return none, none
    layers = np.sort(np.stack([*surfaces.occluded_walls, none]), axis=0)  # NaN last
    return layers[0], layers[1]


def _nearest_ceiling(surfaces: CandidateSurfaces, none: np.ndarray) -> np.ndarray:
    nearest = none
    for ceiling in surfaces.ceilings:
        nearest = np.fmin(nearest, ceiling)
    return nearest
