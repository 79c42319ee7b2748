"""Drawing of the Gaussian map in rerun.

Entities:
    map/splats/<anchor>         Gaussians of one submap in the submap's frame; a loop closure moves the frame
    map_render                  the newest render, from the pose of the newest keyframe
    plots/psnr_db/<what>        PSNR of the newest keyframe: predicted before mapping, and after mapping
    plots/depth_error_m/map     median |rendered - fused depth|
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import rerun as rr

from beamsplat.common.geometry.tracks import RateLimit
from beamsplat.common.geometry.transforms import quat_xyzw_from_matrix
from beamsplat.common.mapfiles.anchor_poses import AnchorPoses
from beamsplat.common.messages.splat_codec import unpack
from beamsplat.common.raster.layout import COLOUR, MEAN, OPACITY, QUAT, SCALE
from beamsplat.services.monitor.rerun_writer import RerunWriter

SPLATS = "map/splats"
RENDER = "map_render"
PLOTS = {"psnr_db": "Render against image, PSNR [dB]", "depth_error_m": "Rendered against fused depth [m]"}


@dataclass
class _Chunk:
    stamp_ns: int
    packed: np.ndarray


class MapLayer:
    """Draws the newest revision of every chunk at a limited rate, and the last revisions at the end.

    Revisions of one mapper process are compared only with each other: a mapper that was restarted without a
    session starts another map, with low revisions and other anchors. What its predecessor sent is removed.
    """

    def __init__(self, writer: RerunWriter, limits: RateLimit) -> None:
        self._writer = writer
        self._limits = limits
        self._producer = ""  # instance of the mapper process whose chunks are drawn
        self._revisions: dict[int, int] = {}
        self._poses = AnchorPoses()
        self._drawn: set[int] = set()  # anchors of which a chunk is drawn
        self._deferred: dict[int, _Chunk] = {}
        self._declared: set[str] = set()

    def chunk(
        self,
        stamp_ns: int,
        producer: str,
        anchor: int,
        revision: int,
        pose: tuple[int, np.ndarray],
        packed: np.ndarray,
    ) -> None:
        """Draw the packed Gaussians of one submap, in its anchor's frame; outdated revisions are ignored.

        Args:
            producer: instance of the mapper process that sent the chunk.
            pose: revision of the pose, and T_map_anchor float64 [4, 4].
            packed: uint8 [B], encoded by `splat_codec`.

        Raises:
            ValueError: the bytes are no packed Gaussians, or there are too many submaps.
        """
        if producer != self._producer:
            self._start_map(producer, stamp_ns)
        moved = self._poses.update(pose[0], [(anchor, pose[1])])
        chunk, newer = _Chunk(stamp_ns, packed), revision >= self._revisions.get(anchor, -1)
        if newer:
            self._revisions[anchor] = revision
        if newer and self._limits.due("splats", stamp_ns, f"{producer} {anchor}"):
            self._deferred.pop(anchor, None)
            self._draw(anchor, chunk)
            return
        if newer:
            self._deferred[anchor] = chunk
        self._draw_poses(stamp_ns, moved)

    def anchors(
        self, stamp_ns: int, producer: str, revision: int, T_map_anchor: dict[int, np.ndarray]
    ) -> None:
        """Move the submaps to the poses (float64 [4, 4]) of all anchors.

        Raises:
            ValueError: there are too many submaps.
        """
        if producer != self._producer:
            self._start_map(producer, stamp_ns)
        self._draw_poses(stamp_ns, self._poses.update(revision, T_map_anchor.items()))

    def _draw_poses(self, stamp_ns: int, anchors: list[int]) -> None:
        for anchor in anchors:
            if anchor in self._drawn:
                self._writer.log(_entity(anchor), self._transform(anchor), stamp_ns=stamp_ns)

    def _transform(self, anchor: int) -> rr.Transform3D:
        T = self._poses.pose(anchor)
        return rr.Transform3D(
            translation=T[:3, 3], quaternion=rr.Quaternion(xyzw=quat_xyzw_from_matrix(T[:3, :3]))
        )

    def _start_map(self, producer: str, stamp_ns: int) -> None:
        """Remove the chunks of the process that sent chunks before."""
        if self._revisions:
            self._writer.log(SPLATS, rr.Clear(recursive=True), stamp_ns=stamp_ns)
        self._producer = producer
        self._revisions.clear()
        self._poses.clear()
        self._drawn.clear()
        self._deferred.clear()

    def _draw(self, anchor: int, chunk: _Chunk) -> None:
        params = unpack(chunk.packed)
        opacity = 1.0 / (1.0 + np.exp(-params[OPACITY]))
        rgba = np.concatenate([params[COLOUR:], opacity[None]]).T
        self._drawn.add(anchor)
        self._writer.log(
            _entity(anchor),
            self._transform(anchor),
            rr.GaussianSplats3D(
                np.ascontiguousarray(params[MEAN:SCALE].T),
                scales=np.ascontiguousarray(np.exp(params[SCALE:QUAT]).T),
                quaternions=np.ascontiguousarray(np.roll(params[QUAT:OPACITY], -1, axis=0).T),
                colors=(np.clip(rgba, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8),
            ),
            stamp_ns=chunk.stamp_ns,
        )

    def render(self, stamp_ns: int, jpeg: np.ndarray) -> None:
        """Draw the image rendered from the newest keyframe's pose; `jpeg`: uint8 [B]."""
        if self._limits.due("image", stamp_ns, RENDER):
            drawing = rr.EncodedImage(contents=jpeg.tobytes(), media_type="image/jpeg")
            self._writer.log(RENDER, drawing, stamp_ns=stamp_ns)

    def metrics(self, stamp_ns: int, predicted_psnr_db: float, psnr_db: float, depth_error_m: float) -> None:
        """Append predicted PSNR, PSNR after mapping (dB) and depth error (m) to the curves; skip NaN."""
        values = (predicted_psnr_db, psnr_db, depth_error_m)
        for name, value in zip(("psnr_db/foretold", "psnr_db/after", "depth_error_m/map"), values):
            if np.isfinite(value):
                if name not in self._declared:
                    self._declared.add(name)
                    label = rr.SeriesLines(names=name.partition("/")[2])
                    self._writer.log(f"plots/{name}", label, static=True)
                self._writer.log(f"plots/{name}", rr.Scalars(value), stamp_ns=stamp_ns)

    def finish(self) -> list[str]:
        """Draw the chunk revisions that were delayed by the rate limit.

        Returns:
            The faults of the chunks that are no packed Gaussians.
        """
        faults = []
        for anchor, chunk in self._deferred.items():
            try:
                self._draw(anchor, chunk)
            except ValueError as error:
                faults.append(str(error))
        self._deferred.clear()
        return faults


def _entity(anchor: int) -> str:
    return f"{SPLATS}/{'odom' if anchor < 0 else anchor}"
