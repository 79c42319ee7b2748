"""`bench depth`: CPU time of depth and fusion on synthetic views of a textured wall."""

from __future__ import annotations

import time

import cv2
import numpy as np

from beamsplat.common.geometry.beams import Beams
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.frames import camera_mount
from beamsplat.common.geometry.transforms import make_transform
from beamsplat.common.messages.image_codec import decode_rgb
from beamsplat.services.depth.source import IGNORES_IMAGE, DepthInput, make_source
from beamsplat.services.fusion.fuse import Fusion
from beamsplat.services.fusion.inputs import FusionInput

_WALL_M = 4.0  # distance of the wall


def bench(source_name: str, frames: int) -> dict[str, float | int | str]:
    """Return median CPU times in ms per 640x480 image on one thread, and the image rates they allow.

    Timed separately: decoding, the depth source, fusion of an image, and fusion of a keyframe.

    Args:
        source_name: name of the depth source.
        frames: number of images; the first one is not counted.
    """
    cv2.setNumThreads(1)
    camera = Pinhole(530.0, 530.0, 319.5, 239.5, 640, 480)
    T_body_camera = camera_mount(0.1, 0.0, 0.45, pitch_down_rad=0.035)
    source = make_source(source_name)
    fusion = Fusion(camera, T_body_camera, floor_known=True, planar=True)
    rng = np.random.default_rng(1)
    wall = cv2.GaussianBlur(rng.integers(0, 255, (960, 1280, 3)).astype(np.uint8), (0, 0), 3)
    times: dict[str, list[float]] = {"decode_ms": [], "source_ms": [], "fusion_ms": [], "keyframe_ms": []}
    for number in range(frames):
        x = 0.04 * number
        data = cv2.imencode(".jpg", _view(wall, camera, _WALL_M - 0.4 * x / 4.0, x))[1].reshape(-1)
        started = time.process_time()
        rgb = decode_rgb(data, "jpeg", camera.width_px, camera.height_px, 0)
        times["decode_ms"].append(1e3 * (time.process_time() - started))
        T_map_body = make_transform(np.eye(3), np.array([0.1 * x, 0.1 * x, 0.0]))
        azimuth = np.linspace(-np.pi, np.pi, 720, endpoint=False)
        reach = np.minimum(_WALL_M / np.maximum(np.cos(azimuth), 0.2), 8.0)
        points = np.stack([reach * np.cos(azimuth), reach * np.sin(azimuth), np.full(720, 0.18)], axis=1)
        beams = Beams(points, np.arange(720), np.full(720, 0.01))
        started = time.process_time()
        estimate = source.estimate(DepthInput(number, rgb, camera, T_body_camera, beams, True))
        times["source_ms"].append(1e3 * (time.process_time() - started))
        frame = FusionInput(number, rgb, T_map_body, beams, estimate.values, estimate.kind)
        for name, keyframe in (("fusion_ms", False), ("keyframe_ms", True)):
            if keyframe and number % 5:
                continue
            started = time.process_time()
            fusion.fuse(frame, keyframe=keyframe)
            times[name].append(1e3 * (time.process_time() - started))
    # The first run compiles kernels or loads them from the cache: it is not counted.
    median = {name: float(np.median(values[1:])) for name, values in times.items()}
    # Both nodes decode the image, unless the source does not use it.
    decodes = 1 if source_name in IGNORES_IMAGE else 2
    per_image_ms = median["source_ms"] + median["fusion_ms"] + decodes * median["decode_ms"]
    return {
        "source": source_name, "width": 640, "height": 480, "threads": 1, "frames": frames,
        "cpu_ms_decode": median["decode_ms"], "decodes": decodes,
        "cpu_ms_source": median["source_ms"], "cpu_ms_fusion": median["fusion_ms"],
        "cpu_ms_keyframe": median["keyframe_ms"], "fps_one_core": 1e3 / per_image_ms,
        "fps_source_alone": 1e3 / median["source_ms"],
        "fps_one_core_with_a_keyframe_a_second": max(1e3 - median["keyframe_ms"], 0.0) / per_image_ms,
    }  # fmt: skip


def _view(wall: np.ndarray, camera: Pinhole, distance_m: float, shift_m: float) -> np.ndarray:
    """Return the camera's view uint8 [H, W, 3] of the wall, whose texture has 300 px per metre."""
    scale = 300.0 * distance_m / camera.fx_px
    A = np.array([[scale, 0.0, 320.0 + 30.0 * shift_m], [0.0, scale, 100.0]])
    return cv2.warpAffine(
        wall, A, (camera.width_px, camera.height_px), flags=cv2.WARP_INVERSE_MAP | cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REFLECT,
    )  # fmt: skip
