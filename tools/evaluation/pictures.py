"""Pictures side by side: image with its beams, raw depth, corrected depth, sigma, truth."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.beams import project_beams
from beamsplat.common.geometry.camera import Pinhole, Undistorter
from beamsplat.common.geometry.rig import load_rig
from beamsplat.services.depth.source import DepthInput, DepthSource
from beamsplat.tools.evaluation.drive import Drive
from beamsplat.tools.evaluation.evaluate import Outcome, read_truth, walk

_Z_RANGE_M = (0.4, 10.0)
_SIGMA_RANGE_M = (0.005, 2.0)


def draw_drive(
    drive: Drive, source: DepthSource, truth: Path | None, every: int, out: Path, floor: bool | None
) -> Iterator[tuple[Path, int]]:
    """Writes a PNG of every n-th picture (of those with truth, if there is any); yields (path, total)."""
    files = read_truth(truth) if truth is not None else {}
    chosen = [image.stamp_ns for image in drive.images if not files or image.stamp_ns in files][::every]
    wanted: dict[int, Path | None] = {stamp: files.get(stamp) for stamp in chosen}
    for outcome in walk(drive, source, wanted, floor=floor):
        path = out / f"{outcome.stamp_ns}.png"
        cv2.imwrite(str(path), panel(outcome, drive))
        yield path, len(wanted)


def panel(outcome: Outcome, drive: Drive) -> np.ndarray:
    """uint8 BGR [H, 4W or 5W, 3]."""
    field = outcome.methods["field"]
    beams = drive.beams(outcome.stamp_ns)
    uv, z, _ = project_beams(beams, drive.undistort.pinhole, drive.T_body_camera)
    image = cv2.cvtColor(outcome.image_rgb, cv2.COLOR_RGB2BGR)
    colours = colour(z[:, None].astype(np.float32), *_Z_RANGE_M)[:, 0]
    for (u, v), c in zip(np.rint(uv).astype(int), colours):
        cv2.circle(image, (int(u), int(v)), 3, tuple(int(k) for k in c), -1)
    tiles = [
        label(image, f"{len(z)} beams"),
        label(
            colour(outcome.estimate.values, *_Z_RANGE_M), f"{outcome.estimate.kind}, as the source gives it"
        ),
        label(colour(field.depth_m, *_Z_RANGE_M), f"field: {field.status}, scale {field.scale:.2f}"),
        label(colour(field.sigma_m, *_SIGMA_RANGE_M), "sigma, 5 mm to 2 m"),
    ]
    if np.isfinite(outcome.truth).any():
        tiles.append(label(colour(outcome.truth, *_Z_RANGE_M), "truth"))
    return np.hstack(tiles)


def draw_image(path: Path, source: DepthSource, rig: Path | None, out: Path) -> Path:
    """One picture without beams: what the source gives. Returns the file written.

    Raises:
        UserError: it is no picture, or the rig belongs to another size.
    """
    bgr = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if bgr is None:
        raise UserError(f"{path}: is no picture that OpenCV can read")
    h, w = bgr.shape[:2]
    if rig is None:
        # A 60 degree lens: without K a network's metric depth is off by the ratio of the focals.
        focal = w / 2.0 / np.tan(np.radians(30.0))
        camera = Pinhole(focal, focal, (w - 1) / 2.0, (h - 1) / 2.0, w, h)
    else:
        loaded = load_rig(rig)
        if loaded.camera is None:
            raise UserError(f"{rig}: has no [camera]")
        camera = Pinhole.of(loaded.camera.model())
    if camera.shape != (h, w):
        raise UserError(f"{rig}: is for {camera.width_px}x{camera.height_px}, {path} is {w}x{h}")
    undistort = Undistorter(camera)
    image = undistort(bgr)
    view = DepthInput(0, cv2.cvtColor(image, cv2.COLOR_BGR2RGB), undistort.pinhole)
    estimate = source.estimate(view)
    near, far = _Z_RANGE_M
    if estimate.kind == "disparity" and np.isfinite(estimate.values).any():
        near, far = (float(v) for v in np.nanpercentile(estimate.values, (2, 98)))
    tile = label(
        colour(estimate.values, max(near, 1e-6), max(far, 2e-6)), f"{estimate.kind}: {estimate.status}"
    )
    target = out / f"{path.stem}_depth.png"
    cv2.imwrite(str(target), np.hstack([image, tile]))
    return target


def colour(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """uint8 BGR [H, W, 3]: logarithmic between `low` and `high`; NaN is black."""
    with np.errstate(invalid="ignore", divide="ignore"):
        place = np.log(values / low) / np.log(high / low)
    grey = (np.clip(np.nan_to_num(place), 0.0, 1.0) * 255).astype(np.uint8)
    painted = cv2.applyColorMap(np.ascontiguousarray(grey), cv2.COLORMAP_TURBO)
    painted[~np.isfinite(values)] = 0
    return painted


def label(picture: np.ndarray, text: str) -> np.ndarray:
    """The picture with a line of text at its top."""
    out = picture.copy()
    cv2.rectangle(out, (0, 0), (out.shape[1], 20), (0, 0, 0), -1)
    cv2.putText(out, text, (5, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA)
    return out
