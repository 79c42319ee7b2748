"""What tests ask a page with the 3D viewer; `box` is the selector of its element."""

import base64
import time

import cv2
import numpy as np
import pytest

from tests.web.map_server import STATIC
from tests.web.scene import CAMERA

BUNDLE = STATIC / "viewer" / "viewer.js"
COUNT = 12_000  # Gaussians where their number does not matter: the browser draws without a GPU
MARKS = [
    pytest.mark.slow,
    pytest.mark.live,
    pytest.mark.skipif(not BUNDLE.exists(), reason="needs the built 3D viewer: make web"),
]


def state(page, box="#view"):
    return page.evaluate(f"document.querySelector('{box}').viewer?.state ?? null")


def wait(page, condition, seconds=30, box="#view"):
    """Wait until the viewer's state fulfils a condition; return the state."""
    end = time.monotonic() + seconds
    while True:
        now = state(page, box)
        if now is not None and condition(now):
            return now
        assert time.monotonic() < end, f"after {seconds} s: {now}, {page.faults}"
        page.wait_for_timeout(50)


def shows(count):
    return lambda now: now["gaussians"] == count and now["complete"]


def picture(page, T_map_camera, box="#view", camera=CAMERA):
    """Return what the viewer draws from a pose, uint8 [H, W, 3], RGB."""
    pinhole = {
        "T_map_camera": T_map_camera.ravel().tolist(), "fx": camera.fx_px, "fy": camera.fy_px, "cx": camera.cx_px,
        "cy": camera.cy_px, "width": camera.width_px, "height": camera.height_px,
    }  # fmt: skip
    text = page.evaluate(
        """async ([box, pinhole]) => {
          const bytes = new Uint8Array(await (await document.querySelector(box).viewer.picture(pinhole)).arrayBuffer());
          return btoa(Array.from(bytes, (b) => String.fromCharCode(b)).join(""));
        }""",
        [box, pinhole],
    )
    return cv2.imdecode(np.frombuffer(base64.b64decode(text), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
