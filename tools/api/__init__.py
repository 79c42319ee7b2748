"""BeamSplat: a metric, photorealistic 3D Gaussian map from one camera and one 2D lidar.

The public Python API. Everything works on NumPy arrays, without the message bus; names are imported when they
are first used. Runnable examples are in the repository's folder `examples/`.

    open_recording      a bag, a recording or a folder of images and scans, as messages in order of arrival
    LidarSlam           2D lidar SLAM: scans and wheel odometry in, poses and an occupancy grid out
    Fusion              metric depth with a standard deviation, from images, poses and lidar beams
    Mapper              keyframes in, an optimised map of 3D Gaussians out
    Rasterizer          differentiable rendering of Gaussians on the CPU, with gradients
    write_gaussian_ply, write_gltf, write_spz    the map as files for other programs
    Node, ...           base class and types for nodes and depth sources of your own

Conventions: `T_a_b` (float64 [4, 4]) transforms points of frame b into frame a; SI units, radians, time in
nanoseconds (int); images are uint8 [H, W, 3] RGB; depth is optical z in metres, NaN = unknown; Gaussians are
float32 [14, N] with the rows of `beamsplat.common.raster.layout`.
"""

from __future__ import annotations

import importlib
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

import beamsplat.common  # noqa: F401  limits BLAS to one thread, before NumPy is imported

if TYPE_CHECKING:
    from beamsplat.common.config.deployment import NodeConfig
    from beamsplat.common.errors import UserError
    from beamsplat.common.geometry.beams import NO_BEAMS, Beams, scan_points
    from beamsplat.common.geometry.camera import Pinhole, Undistorter
    from beamsplat.common.geometry.frames import camera_mount, lidar_mount
    from beamsplat.common.mapfiles.gltf import write_gltf
    from beamsplat.common.mapfiles.ply import write_gaussian_ply
    from beamsplat.common.mapfiles.spz import write_spz
    from beamsplat.common.raster.camera import RasterCamera
    from beamsplat.common.raster.optimiser import GaussianArrays
    from beamsplat.common.raster.rasterizer import Rasterizer
    from beamsplat.common.recording.reader import RecordingReader
    from beamsplat.common.recording.writer import RecordingWriter
    from beamsplat.common.runtime.node import Input, Node, Outputs
    from beamsplat.services.depth.source import DepthInput, DepthSource, Estimate, make_source
    from beamsplat.services.fusion.fuse import Fusion
    from beamsplat.services.fusion.inputs import FusionInput, PlaneSweepConfig
    from beamsplat.services.fusion.result import FusionResult
    from beamsplat.services.localization.lidar2d.job_runner import JobRunner
    from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
    from beamsplat.services.localization.lidar2d.slam import LidarSlam, ScanResult
    from beamsplat.services.mapping.keyframe import RgbdKeyframe
    from beamsplat.services.mapping.mapper import InsertionResult, Mapper
    from beamsplat.services.mapping.settings import MapperSettings
    from beamsplat.services.replay.open import open_recording

_MODULES = {
    "beamsplat.common.config.deployment": ("NodeConfig",),
    "beamsplat.common.errors": ("UserError",),
    "beamsplat.common.geometry.beams": ("NO_BEAMS", "Beams", "scan_points"),
    "beamsplat.common.geometry.camera": ("Pinhole", "Undistorter"),
    "beamsplat.common.geometry.frames": ("camera_mount", "lidar_mount"),
    "beamsplat.common.mapfiles.gltf": ("write_gltf",),
    "beamsplat.common.mapfiles.ply": ("write_gaussian_ply",),
    "beamsplat.common.mapfiles.spz": ("write_spz",),
    "beamsplat.common.raster.camera": ("RasterCamera",),
    "beamsplat.common.raster.optimiser": ("GaussianArrays",),
    "beamsplat.common.raster.rasterizer": ("Rasterizer",),
    "beamsplat.common.recording.reader": ("RecordingReader",),
    "beamsplat.common.recording.writer": ("RecordingWriter",),
    "beamsplat.common.runtime.node": ("Input", "Node", "Outputs"),
    "beamsplat.services.depth.source": ("DepthInput", "DepthSource", "Estimate", "make_source"),
    "beamsplat.services.fusion.fuse": ("Fusion",),
    "beamsplat.services.fusion.inputs": ("FusionInput", "PlaneSweepConfig"),
    "beamsplat.services.fusion.result": ("FusionResult",),
    "beamsplat.services.localization.lidar2d.job_runner": ("JobRunner",),
    "beamsplat.services.localization.lidar2d.settings": ("LidarSlamSettings",),
    "beamsplat.services.localization.lidar2d.slam": ("LidarSlam", "ScanResult"),
    "beamsplat.services.mapping.keyframe": ("RgbdKeyframe",),
    "beamsplat.services.mapping.mapper": ("InsertionResult", "Mapper"),
    "beamsplat.services.mapping.settings": ("MapperSettings",),
    "beamsplat.services.replay.open": ("open_recording",),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}

__all__ = [
    "NO_BEAMS",
    "Beams",
    "DepthInput",
    "DepthSource",
    "Estimate",
    "Fusion",
    "FusionInput",
    "FusionResult",
    "GaussianArrays",
    "Input",
    "InsertionResult",
    "JobRunner",
    "LidarSlam",
    "LidarSlamSettings",
    "Mapper",
    "MapperSettings",
    "Node",
    "NodeConfig",
    "Outputs",
    "Pinhole",
    "PlaneSweepConfig",
    "RasterCamera",
    "Rasterizer",
    "RecordingReader",
    "RecordingWriter",
    "RgbdKeyframe",
    "ScanResult",
    "Undistorter",
    "UserError",
    "camera_mount",
    "lidar_mount",
    "make_source",
    "open_recording",
    "scan_points",
    "write_gaussian_ply",
    "write_gltf",
    "write_spz",
]

try:
    __version__ = version("beamsplat")
except PackageNotFoundError:  # a source tree that is not installed
    __version__ = "0.0.0"


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used: `import beamsplat` itself stays fast."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'beamsplat' has no attribute {name!r}")
    value = getattr(importlib.import_module(_MODULE_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
