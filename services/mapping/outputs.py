"""What the mapper publishes about its map: previews, state, chunks, poses; and the files at its end."""

from __future__ import annotations

import logging
import math

from beamsplat.common.errors import UserError, reason
from beamsplat.common.messages import Keyframe, MapStatus
from beamsplat.common.runtime.node import Job, Node, Outputs
from beamsplat.services.mapping.chunks import ChunkCensus, ChunkFeed, Viewpoint
from beamsplat.services.mapping.config import MappingConfig
from beamsplat.services.mapping.intake import KeyframeIntake
from beamsplat.services.mapping.map_files import write_files
from beamsplat.services.mapping.mapper import InsertionResult, Mapper
from beamsplat.services.mapping.messages import (
    chunk_message,
    poses_message,
    preview_message,
    status_message,
    status_text,
)
from beamsplat.services.mapping.preview import render_keyframe
from beamsplat.services.mapping.session.live_session import MapSession

log = logging.getLogger("beamsplat.mapping")


class MapOutputs(Node):
    """The part of `node.MappingNode` that publishes; the node sets the attributes."""

    config: MappingConfig
    _mapper: Mapper
    _intake: KeyframeIntake
    _session: MapSession
    _feed: ChunkFeed
    _viewpoint: Viewpoint | None  # of the newest keyframe
    _backlog: int  # keyframes that wait on the robot

    def _show(self, message: Keyframe, outcome: InsertionResult, loss: float) -> Outputs:
        preview = render_keyframe(self._mapper, message.id)
        focal_px, error_px = message.camera.fx_px, self.config.chunk_error_px
        self._viewpoint = Viewpoint(preview.T_map_camera[:3, 3], focal_px, error_px)
        yield "mapping/preview", preview_message(message, preview)
        status = self._status(message.stamp_ns, outcome, loss, preview.psnr_db, preview.depth_error_m)
        yield "mapping/status", status

    def _status(
        self, stamp_ns: int, outcome: InsertionResult, loss: float, psnr_db: float = math.nan,
        depth_error_m: float = math.nan,
    ) -> MapStatus:  # fmt: skip
        self._report_owed()
        status = status_message(
            self._mapper, outcome, stamp_ns=stamp_ns, keyframes=len(self._intake.stored()),
            refused=len(self._intake.rejections), loss=loss, psnr_db=psnr_db, depth_error_m=depth_error_m,
            session=self._session.status_text(),
        )  # fmt: skip
        self.detail = status_text(status, self._backlog, self._mapper.engine.description)
        return status

    def _report_owed(self) -> None:
        plan = self._mapper.plan
        self.figures.set("map_owed_steps", plan.count)
        self.rejections.set("optimisation steps never done: too many were owed", plan.dropped)

    def _chunk(self, census: ChunkCensus, anchor: int, stamp_ns: int) -> Outputs:
        """Publish the chunk of an anchor, if there is new visible detail."""
        part = self._feed.take_update(census, anchor)
        if part is not None:
            yield "mapping/chunk", chunk_message(self._mapper, anchor, part, stamp_ns)

    def _publish_all(self) -> Outputs:
        """Publish all chunks that viewers do not have in full detail, and the poses of all keyframes."""
        poses, census = poses_message(self._intake.poses()), ChunkCensus(self._mapper, None)  # in full detail
        for anchor in census.versions:
            yield from self._chunk(census, anchor, poses.stamp_ns)
        yield "mapping/poses", poses

    def _save(self) -> Outputs:
        """Write the last checkpoint; with the option `save`, also splats.ply and the keyframe poses."""
        folder = self.config.save
        stamps_ns, T_map_body, _ = self._intake.poses()
        if (work := self._session.checkpoint(int(stamps_ns[-1]), last=True)) is not None:
            if self.must_stop():  # the runner waits for a job as long as there is time
                yield Job("checkpoint", work)
            else:
                self._session.finish_checkpoint(work())
        if folder is not None:
            try:
                count = write_files(folder, self._mapper, stamps_ns, T_map_body)
            except (OSError, UserError) as error:
                fault = f"mapping.save = {folder}: not written ({reason(error)})"
                if self.live_settings is None:  # lockstep: nothing else continues
                    raise UserError(fault) from error
                self.detail = fault
                log.error("%s", fault)
                return
            log.info("map of %d Gaussians saved to %s", count, folder)
