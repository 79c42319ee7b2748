"""Pictures of a comparison: both maps from above with the objects marked, and renders of each object."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from beamsplat.common.geometry.transforms import inverse
from beamsplat.common.mapfiles.scores import render_rgb_depth
from beamsplat.common.raster.layout import MEAN
from beamsplat.common.raster.rasterizer import Rasterizer
from beamsplat.tools.compare.drive import DepthView, MappedDrive
from beamsplat.tools.compare.objects import ChangedObject
from beamsplat.tools.report.top_view import LabelledBox, extent, top_view

COLOUR_BGR = {"vanished": (40, 40, 220), "appeared": (60, 160, 30)}
# Of an object that only the camera has seen, where a wrong depth of one session would be a surface that
# appeared or vanished; then both maps look the same there. Chosen on the simulated home of seed 7.
MIN_CONTRAST = 2.0
_SIZE_PX = 480  # width of one render of a pair
_MARGIN_M = 0.15  # of a surface before a pixel counts as hidden


@dataclass(frozen=True)
class ObjectPair:
    """The place of an object, rendered from both maps at one keyframe that observed it."""

    keyframe: int
    before: np.ndarray  # uint8 [H, W, 3] BGR, from map a
    after: np.ndarray  # uint8 [H, W, 3] BGR, from map b
    difference: float  # 0..1, mean absolute colour difference of the renders on the object
    typical: float  # the same of all other pixels: what two maps of equal surfaces differ by

    @property
    def looks_changed(self) -> bool:
        """Return whether the object's pixels differ clearly more than all others."""
        return self.difference > MIN_CONTRAST * self.typical


def maps_from_above(a: MappedDrive, b: MappedDrive, objects: list[ChangedObject]) -> np.ndarray | None:
    """Return both maps from above at one scale, map a on the left, BGR uint8; None if a map is empty."""
    params = [drive.store.params[:, : drive.store.count] for drive in (a, b)]
    if not all(p.shape[1] for p in params):
        return None
    corners = np.array([extent(p[MEAN : MEAN + 2]) for p in params])
    shared = np.array([corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)])
    marks = [
        LabelledBox(
            (float(o.low_m[0]), float(o.low_m[1])), (float(o.high_m[0]), float(o.high_m[1])),
            str(number), COLOUR_BGR[o.kind],
        )
        for number, o in enumerate(objects, 1)
    ]  # fmt: skip
    views = (top_view(p, corners_m=shared, boxes=marks) for p in params)
    sides = [view for view in views if view is not None]
    if len(sides) < len(params):
        return None
    for side, text in zip(sides, (f"before: {a.name}", f"after: {b.name}")):
        cv2.putText(side, text, (12, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (0, 0, 0), 2, cv2.LINE_AA)
    gap = np.full((sides[0].shape[0], 8, 3), 255, np.uint8)
    return np.hstack([sides[0], gap, sides[1]])


def object_pair(
    a: MappedDrive,
    b: MappedDrive,
    views: list[DepthView],  # of the session in which the object is there
    found: ChangedObject,
    rasterizer: Rasterizer,
) -> ObjectPair | None:
    """Render both maps at the keyframe that shows most of an object; None if no keyframe shows it."""
    best, most, box = None, 0, np.zeros(4, int)
    for view in views:
        count, where = _in_view(view, found.points_m)
        if count > most:
            best, most, box = view, count, where
    if best is None:
        return None
    c = best.camera
    big = c.resized(_SIZE_PX, round(_SIZE_PX * c.height_px / c.width_px))
    left, top, right, bottom = (np.array(box) * (_SIZE_PX / c.width_px)).astype(int)
    pair = []
    for drive in (a, b):
        rgb, _, _ = render_rgb_depth(rasterizer, drive.store, big, best.T_map_camera)
        pair.append(rgb)
    off = np.abs(pair[0] - pair[1]).mean(axis=2)
    on = np.zeros(off.shape, bool)
    on[top : bottom + 1, left : right + 1] = True
    difference, typical = float(off[on].mean()), float(off[~on].mean()) if not on.all() else 0.0
    drawn = []
    for rgb in pair:
        image = cv2.cvtColor((rgb * 255.0 + 0.5).astype(np.uint8), cv2.COLOR_RGB2BGR)
        cv2.rectangle(image, (int(left), int(top)), (int(right), int(bottom)), COLOUR_BGR[found.kind], 2)
        drawn.append(image)
    return ObjectPair(best.id, drawn[0], drawn[1], difference, typical)


def _in_view(view: DepthView, points_m: np.ndarray) -> tuple[int, np.ndarray]:
    """Return how many points [N, 3] are visible in a view, and their box (left, top, right, bottom) in px."""
    T, c = inverse(view.T_map_camera), view.camera
    x, y, z = (points_m @ T[:3, :3].T + T[:3, 3]).T
    ahead = np.maximum(z, 1e-3)
    u, v = np.round(x / ahead * c.fx_px + c.cx_px), np.round(y / ahead * c.fy_px + c.cy_px)
    index = np.flatnonzero((z > 0.3) & (u >= 0) & (v >= 0) & (u < c.width_px) & (v < c.height_px))
    row, column = v[index].astype(int), u[index].astype(int)
    with np.errstate(invalid="ignore"):
        shown = ~(view.rendered_m[row, column].astype(np.float32) < z[index] - _MARGIN_M)
    row, column = row[shown], column[shown]
    if len(row) == 0:
        return 0, np.zeros(4, int)
    return len(row), np.array([column.min(), row.min(), column.max(), row.max()])
