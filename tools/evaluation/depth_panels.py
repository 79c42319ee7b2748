"""Panels for visual inspection: image with beams, raw depth, corrected depth, sigma, true depth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.beams import project_beams
from beamsplat.common.geometry.camera import Pinhole, Undistorter
from beamsplat.common.geometry.rig import load_rig
from beamsplat.services.depth.source import DepthInput, DepthSource
from beamsplat.tools.evaluation.depth_replay import DepthComparison, replay_depth, truth_depth_files
from beamsplat.tools.evaluation.drive import RecordedDrive

_Z_RANGE_M = (0.4, 10.0)  # colour range of depth
_SIGMA_RANGE_M = (0.005, 2.0)  # colour range of sigma


def draw_depth_panels(
    drive: RecordedDrive,
    source: DepthSource,
    truth: Path | None,
    every: int,
    out: Path,
    floor: bool | None,
    refuse: Callable[[str], None],
) -> Iterator[tuple[str, int]]:
    """Write a panel of every n-th image as PNG; yield (status of its depth, number of panels) for each.

    Args:
        truth: folder of true depth; only images with a true depth are then used. None: no true depth.
        every: n.
        out: folder of the panels.
        floor: whether the camera's height above the floor is known; None: if the poses are planar.
        refuse: receives the reason for each image that cannot be decoded.
    """
    files = truth_depth_files(truth) if truth is not None else {}
    chosen = [image.stamp_ns for image in drive.images if not files or image.stamp_ns in files][::every]
    wanted: dict[int, Path | None] = {stamp: files.get(stamp) for stamp in chosen}
    for outcome in replay_depth(drive, source, wanted, floor=floor, refuse=refuse):
        path = out / f"{outcome.stamp_ns}.png"
        cv2.imwrite(str(path), depth_panel(outcome, drive))
        yield outcome.methods["field"].status, len(wanted)


def depth_panel(outcome: DepthComparison, drive: RecordedDrive) -> np.ndarray:
    """Return the panel of one image, BGR uint8 [H, 4 W, 3], or [H, 5 W, 3] if true depth is known.

    Tiles from left to right: image with beams, depth estimate, fused depth, sigma, true depth.
    """
    field = outcome.methods["field"]
    beams = drive.beams_at(outcome.stamp_ns)
    uv, z, _ = project_beams(beams, drive.undistort.pinhole, drive.T_body_camera)
    image = cv2.cvtColor(outcome.image_rgb, cv2.COLOR_RGB2BGR)
    colours = colourize(z[:, None].astype(np.float32), *_Z_RANGE_M)[:, 0]
    for (u, v), c in zip(np.rint(uv).astype(int), colours):
        cv2.circle(image, (int(u), int(v)), 3, tuple(int(k) for k in c), -1)
    tiles = [
        label(image, f"{len(z)} beams"),
        label(
            colourize(outcome.estimate.values, *_Z_RANGE_M),
            f"{outcome.estimate.kind}, as estimated by the source",
        ),
        label(colourize(field.depth_m, *_Z_RANGE_M), f"field: {field.status}, scale {field.scale:.2f}"),
        label(colourize(field.sigma_m, *_SIGMA_RANGE_M), "sigma, 5 mm to 2 m"),
    ]
    if np.isfinite(outcome.truth).any():
        tiles.append(label(colourize(outcome.truth, *_Z_RANGE_M), "truth"))
    return np.hstack(tiles)


def draw_depth_of_image(path: Path, source: DepthSource, rig: Path | None, out: Path) -> Path:
    """Estimate the depth of one image file, write both side by side as PNG, and return the written file.

    Without a rig, a horizontal field of view of 60 degrees is assumed.

    Raises:
        UserError: the file is not an image, or the rig is for another image size.
    """
    bgr = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if bgr is None:
        raise UserError(f"{path} is not an image that OpenCV can read")
    h, w = bgr.shape[:2]
    if rig is None:
        # Assume a field of view of 60 degrees: metric depth is then wrong by the ratio of the focal lengths.
        focal = w / 2.0 / np.tan(np.radians(30.0))
        camera = Pinhole(focal, focal, (w - 1) / 2.0, (h - 1) / 2.0, w, h)
    else:
        loaded = load_rig(rig)
        if loaded.camera is None:
            raise UserError(f"{rig} has no [camera]")
        camera = Pinhole.of(loaded.camera.model())
    if camera.shape != (h, w):
        raise UserError(
            f"{rig} is for images of {camera.width_px}x{camera.height_px}, but {path} has {w}x{h}"
        )
    undistort = Undistorter(camera)
    image = undistort(bgr)
    view = DepthInput(0, cv2.cvtColor(image, cv2.COLOR_BGR2RGB), undistort.pinhole)
    estimate = source.estimate(view)
    near, far = _Z_RANGE_M
    if estimate.kind == "disparity" and np.isfinite(estimate.values).any():
        near, far = (float(v) for v in np.nanpercentile(estimate.values, (2, 98)))
    tile = label(
        colourize(estimate.values, max(near, 1e-6), max(far, 2e-6)), f"{estimate.kind}: {estimate.status}"
    )
    target = out / f"{path.stem}_depth.png"
    cv2.imwrite(str(target), np.hstack([image, tile]))
    return target


def colourize(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return values [H, W] as an image BGR uint8 [H, W, 3] in pseudo colours; NaN is black.

    The colour scale is logarithmic from `low` to `high`, which are in the unit of the values.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        place = np.log(values / low) / np.log(high / low)
    grey = (np.clip(np.nan_to_num(place), 0.0, 1.0) * 255).astype(np.uint8)
    painted = cv2.applyColorMap(np.ascontiguousarray(grey), cv2.COLORMAP_TURBO)
    painted[~np.isfinite(values)] = 0
    return painted


def label(image: np.ndarray, text: str) -> np.ndarray:
    """Return a copy of an image uint8 [H, W, 3] with a line of text at its top."""
    out = image.copy()
    cv2.rectangle(out, (0, 0), (out.shape[1], 20), (0, 0, 0), -1)
    cv2.putText(out, text, (5, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA)
    return out
