"""The mapping service: keyframes in; Gaussians, renders and how good they are out."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from functools import lru_cache
from itertools import chain

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.files.persist import check_can_write
from beamsplat.common.geometry.camera import Undistorter
from beamsplat.common.geometry.transforms import inverse
from beamsplat.common.mapfiles.ply import write_map
from beamsplat.common.messages import Anchors, Keyframe, MapChunk, MapPoses, MapState, MapStatus, Tick
from beamsplat.common.runtime.node import Input, Outputs
from beamsplat.services.mapping.chunks import ChunkFeed, Viewpoint, chunk_snapshot, disk_params
from beamsplat.services.mapping.config import MappingConfig
from beamsplat.services.mapping.keyframe import StoredKeyframe
from beamsplat.services.mapping.mapper import FULL, HALF, InsertionResult, Mapper
from beamsplat.services.mapping.messages import (
    ack,
    chunk_message,
    decode_keyframe,
    encode_keyframe,
    preview_message,
    state_messages,
    viewpoint_of,
)
from beamsplat.services.mapping.preview import render_keyframe
from beamsplat.services.mapping.session.node import SessionNode
from beamsplat.services.mapping.session.paging import check_budget
from beamsplat.services.mapping.session.state import arrays_of
from beamsplat.services.mapping.settings import MapperSettings
from beamsplat.services.mapping.warm import warm

log = logging.getLogger("beamsplat.mapping")

ODOM_ORIGIN = -1  # the anchor of keyframes from before localization named one


class MappingNode(SessionNode):
    """Takes every keyframe, in any order. With a session each is acknowledged as soon as it is on this disk,
    without one when it is in the map."""

    name = "mapping"
    Config = MappingConfig
    # Of keyframes few need to wait here: they wait on this disk too (a session), or on the robot's.
    inputs = (
        Input("keyframes/frame", queued_bytes=32_000_000), Input("localization/anchors", "every"),
        Input("tick", "latest"),
    )  # fmt: skip
    outputs = ("keyframes/ack", "mapping/chunk", "mapping/poses", "mapping/preview", "mapping/status")
    config: MappingConfig

    def check_resources(self) -> None:
        """Check the memory budget, and that the folders can be written."""
        c = self.config
        if c.memory_mb is not None:
            check_budget(c.memory_mb, c.session)
        for option, folder in (("save", c.save), ("session", c.session)):
            if folder is not None:
                check_can_write(folder, option)

    def configure(self) -> None:
        c = self.config
        warm()
        settings = MapperSettings(
            half_iterations=c.half_steps, full_iterations=c.full_steps, max_gaussians=c.gaussians(),
            max_keyframes=c.max_keyframes, refine_pose=c.refine_pose, refine_exposure=c.refine_exposure,
        )  # fmt: skip
        self._mapper = Mapper(settings, seed=c.seed, threads=c.threads)
        self._lens = lru_cache(maxsize=4)(Undistorter)  # its maps are made once a calibration
        self._taken: dict[int, tuple[int, np.ndarray]] = {}  # keyframe -> stamp_ns, T_camera_body
        self._feed = ChunkFeed()
        self._eye: Viewpoint | None = None  # where the newest keyframe looks from
        self._refusals: dict[int, str] = {}  # keyframe -> why
        # The oldest submap's place when the origin was tied to it.
        self._T_oldest_origin: np.ndarray | None = None
        if c.memory_mb is not None:
            check_budget(c.memory_mb, c.session)
        if not self.in_standby:
            self.take_over()

    # --- keyframes ---

    def on_keyframes_frame(self, message: Keyframe) -> Outputs:
        """Insertion and the fixed steps; then how well the picture is explained, and what has changed."""
        if message.id in self._resumed:
            self._resumed -= {message.id}
            return
        kept = self._arrivals is not None and self._arrivals.start(message.id)
        known = self._mapper.was_inserted(message.id)
        outcome = InsertionResult("ok") if known else self._take(message)
        if not outcome.ok or (not kept and self._kept(message, known)):
            yield ack(message, outcome.status)
        if known:  # sent again while the answer was on its way
            return
        if not outcome.ok:
            self._refuse(message.id, outcome.status)
            yield "mapping/status", self._status(message.stamp_ns, outcome, 0.0)
            return
        waiting = message.backlog + (0 if self._arrivals is None else len(self._arrivals))
        share = min(self.config.calm_backlog / max(waiting, 1), 1.0)
        c = self.config
        loss = self._mapper.optimise(math.ceil(c.half_steps * share), math.ceil(c.full_steps * share))
        self._page()
        yield from self._show(message, outcome, loss)
        if len(self._mapper.keyframes) % self.config.chunk_every == 0:
            yield from self._chunk(message.anchor_id, message.stamp_ns)
        yield from self._checkpoint(message.stamp_ns)

    def _take(self, message: Keyframe) -> InsertionResult:
        foreign = self._foreign(message.map_uuid)
        if foreign:
            return InsertionResult(foreign)
        try:
            frame = decode_keyframe(message, self._lens)
        except (UserError, ValueError) as error:
            return InsertionResult(str(error))
        return self._add(frame, message)

    def _kept(self, message: Keyframe, known: bool) -> bool:
        """Whether an accepted keyframe survives this process, as far as that was asked for."""
        keeper = self._keeper
        if keeper is None or (known and not keeper.is_unwritten(message.id)):
            return True
        return keeper.write_keyframe(message.id, *encode_keyframe(message))

    # --- anchors and time ---

    def on_localization_anchors(self, anchors: Anchors) -> Outputs:
        """The pose graph has moved: Gaussians move along at once, some steps mend the seams."""
        foreign = self._foreign(anchors.map_uuid)
        if foreign:
            log.warning("anchors are left out: %s", foreign)
            return
        places = {int(a): T for a, T in zip(anchors.anchor_ids, anchors.T_map_anchor)}
        self._tie_origin(places)
        if self._mapper.move_anchors(places) and self._mapper.keyframes:
            if self._keeper is not None:
                self._keeper.anchors_moved(self._mapper)
            self._mapper.refine(self.config.mend_steps, HALF)
            for anchor in places:
                yield from self._chunk(anchor, anchors.stamp_ns)

    def _tie_origin(self, places: dict[int, np.ndarray]) -> None:
        """What hangs on the odom frame's origin goes with the oldest submap, which began there."""
        origin = self._mapper.T_map_anchor.get(ODOM_ORIGIN)
        if origin is None or not places:
            return
        oldest = places[min(places)]
        if self._T_oldest_origin is None:
            self._T_oldest_origin = inverse(oldest) @ origin
        places[ODOM_ORIGIN] = oldest @ self._T_oldest_origin

    def on_tick(self, tick: Tick) -> Outputs:
        """Time passes and no keyframe waits: steps on all keyframes, and the chunk sent longest ago."""
        if not self._mapper.keyframes:
            return
        if self._arrivals is not None and self._arrivals.has_skipped:
            yield from self._overtaken()
        else:
            self._mapper.refine(self.config.tick_steps, FULL)
            self._page()
        longest = self._feed.oldest_due(self._mapper, self._eye)
        if longest is not None:
            yield from self._chunk(longest, tick.stamp_ns)
        yield from self._checkpoint(tick.stamp_ns)

    # --- what is said ---

    def _show(self, message: Keyframe, outcome: InsertionResult, loss: float) -> Outputs:
        view = render_keyframe(self._mapper, message.id)
        self._eye = Viewpoint(view.T_map_camera[:3, 3], message.camera.fx_px, self.config.chunk_error_px)
        yield "mapping/preview", preview_message(message, view)
        status = self._status(message.stamp_ns, outcome, loss, view.psnr_db, view.depth_error_m)
        yield "mapping/status", status

    def _held(self) -> dict[int, StoredKeyframe]:
        """All keyframes, those on disk too."""
        return self._mapper.keyframes | self._mapper.paged_out

    def _status(
        self, stamp_ns: int, outcome: InsertionResult, loss: float, psnr_db: float = math.nan,
        depth_error_m: float = math.nan,
    ) -> MapStatus:  # fmt: skip
        m, held = self._mapper, len(self._held())
        gaussians = m.store.count + m.store.paged_out_count
        self.detail = f"{held} keyframes, {gaussians} Gaussians, {psnr_db:.1f} dB" + (
            f", {len(self._refusals)} refused (last: {outcome.status})" if not outcome.ok else ""
        )
        session = "" if self._keeper is None else self._keeper.status_text(m)
        self.detail += f"; {session}" if session else ""
        return MapStatus(
            stamp_ns=stamp_ns, status=outcome.status, keyframes=held, refused=len(self._refusals),
            gaussians=gaussians, steps=m.steps, loss=loss, foretold_share=outcome.foretold_share,
            foretold_psnr_db=outcome.foretold_psnr_db, psnr_db=psnr_db, depth_error_m=depth_error_m,
            session=session,
        )  # fmt: skip

    def _chunk(self, anchor: int, stamp_ns: int, whole: bool = False) -> Outputs:
        """An anchor's Gaussians, unless viewers have all of them that show; `whole`: all detail."""
        part = self._feed.take_update(self._mapper, anchor, None if whole else self._eye)
        if part is not None:
            yield "mapping/chunk", chunk_message(self._mapper.T_map_anchor[anchor], anchor, part, stamp_ns)

    def on_query_snapshot(self, parameters: dict[str, str]) -> Iterator[MapChunk]:
        """The whole map, chunk by chunk, for who comes late; `from=X,Y,Z` (m, map), `focal_px` and `error_px`
        leave out the detail that cannot be seen from there."""
        for anchor, part in chunk_snapshot(self._mapper, viewpoint_of(parameters)).items():
            yield chunk_message(self._mapper.T_map_anchor[anchor], anchor, part, 0)

    def on_query_state(self, parameters: dict[str, str]) -> Iterator[MapState]:
        """All that a checkpoint holds, as it is now, in pieces."""
        if not self._mapper.keyframes:
            raise UserError("the map is empty so far")
        arrays = arrays_of(self._mapper, self._extra())
        yield from state_messages(arrays if self._keeper is None else self._keeper.with_disk_gaussians(arrays))

    def drain(self) -> Outputs:
        """The map as the data left it; then, if asked for, refined; and the files asked for."""
        if self._arrivals is not None:
            self._arrivals.skip_waiting()
        while self._arrivals:
            yield from self._overtaken()
        if not self._mapper.keyframes:
            return
        yield from self._whole()
        if self.config.final_steps:
            self._mapper.refine(self.config.final_steps, FULL)
            yield from self._whole()
        self._save()

    def _whole(self) -> Outputs:
        """Chunks that changed since they were sent, and all poses."""
        m = self._mapper
        stamps_ns, T_map_body, ids = self._poses()
        last_ns = int(stamps_ns[-1])
        for anchor in m.store.versions():
            yield from self._chunk(anchor, last_ns, whole=True)
        poses = MapPoses(stamp_ns=last_ns, keyframe_ids=ids, stamps_ns=stamps_ns, T_map_body=T_map_body)
        yield "mapping/poses", poses

    def _poses(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(stamps_ns [K] rising, T_map_body [K, 4, 4] refined, ids [K]) of the keyframes held."""
        held = self._held()
        ids = sorted(held, key=lambda id: (self._taken[id][0], id))
        T_map_body = np.array([self._mapper.T_map_camera(held[id]) @ self._taken[id][1] for id in ids])
        stamps_ns = np.array([self._taken[id][0] for id in ids], np.int64)
        return stamps_ns, T_map_body, np.array(ids, np.int64)

    def _save(self) -> None:
        m = self._mapper
        stamps_ns, T_map_body, _ = self._poses()
        if self._keeper is not None:
            self._keeper.finish_checkpoint(self._keeper.checkpoint(m, self._extra(), int(stamps_ns[-1]))())
        if self.config.save is not None:
            away = (part for anchor in list(m.store.paged_out) for part in disk_params(m, anchor))
            parts_map = chain([m.store.params[:, : m.store.count]], away)
            count = m.store.count + m.store.paged_out_count
            write_map(self.config.save, count, parts_map, stamps_ns, T_map_body)
            log.info("map of %d Gaussians saved to %s", count, self.config.save)
