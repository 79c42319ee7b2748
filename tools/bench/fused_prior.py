"""Fused depth and masks of dynamic objects along a drive: the inputs of the mapper in `bench map`.

In the running system, the services fusion and keyframes compute them. Held-out images are not passed to
fusion.
"""

from __future__ import annotations

import numpy as np

from beamsplat.common.geometry.beams import Beams
from beamsplat.common.geometry.depth_sigma import typical_sigma_m
from beamsplat.common.geometry.transforms import inverse, transform_points
from beamsplat.services.depth.source import DepthInput, DepthSource, make_source
from beamsplat.services.fusion.free_space import FreeSpaceGrid
from beamsplat.services.fusion.fuse import Fusion
from beamsplat.services.fusion.inputs import FusionInput
from beamsplat.services.keyframes.dynamic_mask import dynamic_object_mask
from beamsplat.tools.bench.mapping import HELD_OUT_AT, HELD_OUT_EVERY
from beamsplat.tools.evaluation.dataset import TruthDataset


class FusedDepthPrior:
    """Depth prior of `bench map` that is computed by the algorithm of the fusion service.

    Call it with increasing image indices. As in the service, fusion also processes the images between two
    calls. An index that is not higher than the last one starts fusion anew, from the first image.
    """

    def __init__(self, source: str = "stixel") -> None:
        self._source: DepthSource = make_source(source, {})
        self._fusion: Fusion | None = None
        self._next = 0

    def __call__(self, recording: TruthDataset, index: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Return (depth_m, sigma_m) float32 [H, W] of image `index`: optical z and its standard deviation.

        As the mapper decodes keyframes, it is without gross errors. None if fusion rejects the image.
        """
        T_camera_body = inverse(recording.T_body_camera)
        if self._fusion is None or index < self._next:
            poses = np.array(
                [posed_image.T_map_camera @ T_camera_body for posed_image in recording.posed_images]
            )
            upright = bool(np.all(poses[:, 2, 2] > np.cos(np.radians(2.0))))
            self._level = upright and float(np.ptp(poses[:, 2, 3])) < 0.03
            self._fusion = Fusion(
                recording.camera, recording.T_body_camera, floor_known=self._level, planar=self._level
            )
            self._next = 0
        for number in range(self._next, index + 1):
            posed_image = recording.posed_images[number]
            T_map_body = posed_image.T_map_camera @ T_camera_body
            self._fusion.add_scan(transform_points(T_map_body, posed_image.beams.points_body_m))
            if number < index and number % HELD_OUT_EVERY != HELD_OUT_AT:
                self._fusion.look(recording.image(number), T_map_body)
        self._next = index + 1
        fused = self._fusion.fuse(self._frame(recording, index, T_map_body), keyframe=True)
        return (fused.depth_m, typical_sigma_m(fused.depth_m, fused.sigma_m)) if fused.ok else None

    def _frame(self, recording: TruthDataset, index: int, T_map_body: np.ndarray) -> FusionInput:
        posed_image, rgb = recording.posed_images[index], recording.image(index)
        view = DepthInput(
            posed_image.stamp_ns,
            rgb,
            recording.camera,
            recording.T_body_camera,
            posed_image.beams,
            self._level,
        )
        estimate = self._source.estimate(view)
        usable = estimate.ok and estimate.kind != "none"
        return FusionInput(
            posed_image.stamp_ns,
            rgb,
            T_map_body,
            posed_image.beams,
            estimate.values if usable else None,
            estimate.kind,
        )


class DynamicObjectMasks:
    """Detector of dynamic objects: they return beams from space that earlier beams passed through.

    Call it with increasing image indices. An index that is not higher than the last one starts anew.
    """

    def __init__(self) -> None:
        self._free, self._next = FreeSpaceGrid(), 0

    def __call__(self, recording: TruthDataset, index: int, depth_m: np.ndarray) -> np.ndarray | None:
        """Return the mask bool [H, W] of image `index`, False on dynamic objects; None if no beam hits one.

        `depth_m` is the depth of the image, float32 [H, W].
        """
        T_camera_body = inverse(recording.T_body_camera)
        if index < self._next:
            self._free, self._next = FreeSpaceGrid(), 0
        for number in range(self._next, index + 1):
            posed_image = recording.posed_images[number]
            T_map_body = posed_image.T_map_camera @ T_camera_body
            points = transform_points(T_map_body, posed_image.beams.points_body_m)
            moving = self._free.dynamic_returns(points)
            still: Beams = posed_image.beams.take(~moving)
            self._free.add(T_map_body[:3, 3], transform_points(T_map_body, still.points_body_m))
        self._next = index + 1
        if not moving.any():
            return None
        body = posed_image.beams.points_body_m[moving]
        return ~dynamic_object_mask(body, depth_m, recording.camera, recording.T_body_camera)
