"""Runs every kernel of camera tracking once, so that a service finds them compiled."""

from __future__ import annotations

import numpy as np

from beamsplat.common.geometry.camera import Pinhole
from beamsplat.services.localization.camera.depth import DepthGuess
from beamsplat.services.localization.camera.settings import CameraTrackerSettings
from beamsplat.services.localization.camera.tracker import CameraTracker

_SIZE = (128, 96)


def warm() -> None:
    """Three pictures of a textured wall: a map, tracking, a second keyframe."""
    width, height = _SIZE
    random = np.random.default_rng(0)
    picture = np.kron(random.integers(0, 255, (height // 8, width // 8, 3)), np.ones((8, 8, 1))).astype(
        np.uint8
    )
    camera = Pinhole(100.0, 100.0, 63.5, 47.5, width, height)
    settings = CameraTrackerSettings(width_px=width, first_steps=1, exact_steps=1, least_explained=1.1)
    tracker = CameraTracker(camera, np.eye(4), settings)
    guess = DepthGuess(np.full((height, width), 2.0, np.float32), 0.1, True)
    for stamp_ns in (1, 2, 3):
        tracker.track(stamp_ns, picture)
        tracker.add_depth(stamp_ns, guess)
    tracker.close()
