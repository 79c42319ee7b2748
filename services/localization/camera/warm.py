"""Compilation of all kernels of camera tracking, so that the service does not compile them at run time."""

from __future__ import annotations

import numpy as np

from beamsplat.common.geometry.camera import Pinhole
from beamsplat.services.localization.camera.depth import DepthPrior
from beamsplat.services.localization.camera.settings import CameraTrackerSettings
from beamsplat.services.localization.camera.tracker import CameraTracker

_SIZE_PX = (128, 96)


def warm() -> None:
    """Run every kernel once: track three images of a textured wall with two keyframes."""
    width, height = _SIZE_PX
    random = np.random.default_rng(0)
    image = np.kron(random.integers(0, 255, (height // 8, width // 8, 3)), np.ones((8, 8, 1))).astype(
        np.uint8
    )
    camera = Pinhole(100.0, 100.0, 63.5, 47.5, width, height)
    settings = CameraTrackerSettings(width_px=width, first_steps=1, rasterizer_steps=1, min_coverage=1.1)
    tracker = CameraTracker(camera, np.eye(4), settings)
    prior = DepthPrior(np.full((height, width), 2.0, np.float32), 0.1, True)
    for stamp_ns in (1, 2, 3):
        tracker.track(stamp_ns, image)
        tracker.add_depth(stamp_ns, prior)
    tracker.close()
