"""Remove duplicate surfaces after merging two maps.

Both maps are rendered separately from every keyframe. Where both maps cover a pixel at the same depth, the
map whose render has the smaller colour error wins the pixel, and the other map loses it. Gaussians that are
on lost pixels more often than on won pixels are removed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import cv2
import numpy as np

from beamsplat.common.geometry.transforms import inverse
from beamsplat.common.mapfiles.blocks import Arrays
from beamsplat.common.mapfiles.scores import render_rgb_depth
from beamsplat.common.mapfiles.state import KeyframeView, keyframe_views, store_of
from beamsplat.common.mapfiles.store import GaussianStore
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.layout import MEAN, SCALE
from beamsplat.common.raster.rasterizer import Rasterizer
from beamsplat.services.mapping.keyframe import RgbdKeyframe, compress
from beamsplat.services.mapping.mapper import HALF

_COVERED = 0.5  # alpha above which a map shows a surface
_SAME_M, _SAME_RATIO = 0.15, 0.10  # largest depth difference of one surface: absolute plus relative
_BLUR_PX = 11  # colour errors are averaged: neighbouring pixels should choose the same map


def without_duplicates(
    arrays: Arrays,  # of two maps, from `merged`
    second: np.ndarray,  # bool [N]: Gaussians of the second map
    decode: Callable[[int], RgbdKeyframe],  # reads a keyframe by its id; raises ValueError
    progress: Callable[[list[KeyframeView]], Iterable[KeyframeView]] = iter,  # may show a progress bar
) -> np.ndarray:
    """Return bool [N]: False for the Gaussians of duplicate surfaces, which are to be removed.

    Keyframes that cannot be decoded are skipped.
    """
    stores = [_selected(arrays, ~second), _selected(arrays, second)]
    votes = [np.zeros(store.count, np.int32) for store in stores]
    exposure = dict(zip(arrays["keyframe_id"].tolist(), arrays["keyframe_exposure"]))
    rasterizer = Rasterizer()
    for view in progress(keyframe_views(arrays)):
        try:
            level = compress(decode(view.id), 1.0).levels[HALF]
        except ValueError:
            continue
        image, e = level.rgb.transpose(1, 2, 0) * np.float32(1 / 255), exposure[view.id]
        seen = [render_rgb_depth(rasterizer, store, level.camera, view.T_map_camera) for store in stores]
        both = _same_surface(seen)
        if level.hidden is not None:
            both &= ~level.hidden
        shown = [rgb * np.exp(e[:3]) + e[3:] for rgb, _, _ in seen]
        off = [cv2.blur(np.abs(rgb - image).mean(axis=2), (_BLUR_PX, _BLUR_PX)) for rgb in shown]
        for which, store in enumerate(stores):
            won = np.where(both, np.sign(off[1 - which] - off[which]), 0.0).astype(np.int32)
            _add_votes(votes[which], won, store, level.camera, view.T_map_camera, seen[which][1])
    rasterizer.close()
    stay = np.ones(len(second), bool)
    stay[~second], stay[second] = votes[0] >= 0, votes[1] >= 0
    return stay


def _selected(arrays: Arrays, chosen: np.ndarray) -> GaussianStore:
    store = store_of(arrays)
    store.keep(chosen)
    return store


def _same_surface(seen: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> np.ndarray:
    (_, depth_a, alpha_a), (_, depth_b, alpha_b) = seen
    with np.errstate(invalid="ignore"):
        near = np.abs(depth_a - depth_b) < _SAME_M + _SAME_RATIO * np.minimum(depth_a, depth_b)
    return near & (alpha_a > _COVERED) & (alpha_b > _COVERED)


def _add_votes(
    votes: np.ndarray,  # int32 [N], added to
    won: np.ndarray,  # int32 [H, W]: 1 won, -1 lost, 0 not compared
    store: GaussianStore,
    camera: RasterCamera,
    T_map_camera: np.ndarray,
    depth_m: np.ndarray,  # float32 [H, W] of this map, rendered alone
) -> None:
    """Add to the votes of each Gaussian on the visible surface the value of `won` at its pixel."""
    T = inverse(T_map_camera)
    x, y, z = T[:3, :3] @ store.params[MEAN:SCALE, : store.count] + T[:3, 3:4]
    ahead = np.maximum(z, 1e-3)
    u = np.round(x / ahead * camera.fx_px + camera.cx_px)
    v = np.round(y / ahead * camera.fy_px + camera.cy_px)
    inside = np.flatnonzero((z > 0.05) & (u >= 0) & (v >= 0) & (u < camera.width_px) & (v < camera.height_px))
    row, column = v[inside].astype(int), u[inside].astype(int)
    shown = depth_m[row, column]
    with np.errstate(invalid="ignore"):
        on = np.abs(z[inside] - shown) < _SAME_M + _SAME_RATIO * shown
    votes[inside[on]] += won[row[on], column[on]]
