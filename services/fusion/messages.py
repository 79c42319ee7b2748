"""Conversion of fusion results to messages."""

from __future__ import annotations

import numpy as np

from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.transforms import transform_points
from beamsplat.common.messages import Cloud, FusedDepth
from beamsplat.services.fusion.image_work import CandidateImage
from beamsplat.services.fusion.inputs import FusionInput
from beamsplat.services.fusion.result import FusionResult


def depth_message(candidate: CandidateImage, fused: FusionResult, keyframe: bool) -> FusedDepth:
    """Return the message of an accepted result."""
    frame = candidate.frame
    return FusedDepth.of(
        fused.depth_m,
        fused.sigma_m,
        stamp_ns=frame.stamp_ns,
        keyframe=keyframe,
        scale=float(fused.scale),
        scale_sigma=float(fused.scale_sigma),
        inlier_share=float(fused.inlier_share),
        residual_m=float(fused.residual_m),
        pairs=fused.pairs,
        beams_age_ns=candidate.beams_age_ns,
        T_odom_body=frame.T_map_body,
    )


def rejected_message(stamp_ns: int, status: str, keyframe: bool = False) -> FusedDepth:
    """Return the message of an image without depth, whose `status` is the reason."""
    empty = np.zeros(0, np.uint8)
    return FusedDepth(stamp_ns=stamp_ns, depth=empty, sigma=empty, status=status, keyframe=keyframe)


def cloud_message(
    frame: FusionInput, fused: FusionResult, camera: Pinhole, T_body_camera: np.ndarray, every_px: int
) -> Cloud:
    """Return the depth of a keyframe as coloured points; every `every_px`-th pixel in each direction."""
    depth = fused.depth_m[::every_px, ::every_px]
    known = np.isfinite(depth)
    points = (camera.ray_grid()[::every_px, ::every_px] * depth[..., None])[known]
    return Cloud(
        stamp_ns=frame.stamp_ns,
        points_odom_m=transform_points(frame.T_map_body @ T_body_camera, points).astype(np.float32),
        colours=frame.image_rgb[::every_px, ::every_px][known],
    )
