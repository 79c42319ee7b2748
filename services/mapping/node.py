"""The mapping service: inserts keyframes, optimises Gaussians, publishes chunks, previews and status."""

from __future__ import annotations

import logging

from beamsplat.common.engines.choice import check_cuda, cuda_obstacle
from beamsplat.common.files.persist import check_can_write
from beamsplat.common.messages import Anchors, Keyframe, Message, Tick
from beamsplat.common.messages.header import Header
from beamsplat.common.runtime.node import Input, Job, Node, Outputs, StopRequested
from beamsplat.services.mapping.chunks import ChunkCensus, ChunkFeed
from beamsplat.services.mapping.config import MappingConfig
from beamsplat.services.mapping.engines.choice import OPTION, make_engine
from beamsplat.services.mapping.intake import KeyframeIntake
from beamsplat.services.mapping.mapper import FULL, HALF, InsertionResult, Mapper
from beamsplat.services.mapping.messages import ack, anchors_message
from beamsplat.services.mapping.outputs import MapOutputs
from beamsplat.services.mapping.query_handlers import MapQueries
from beamsplat.services.mapping.session.budgets import check_budget, check_gpu_budget
from beamsplat.services.mapping.session.checkpointer import CheckpointResult
from beamsplat.services.mapping.session.live_session import LiveSession, MapSession, NoSession
from beamsplat.services.mapping.warm import warm

log = logging.getLogger("beamsplat.mapping")


class MappingNode(MapQueries, MapOutputs):
    """Inserts keyframes, in any order of arrival, and optimises the map.

    With a session, a keyframe is acknowledged as soon as it is stored in the session on disk; without a
    session, as soon as it is in the map.
    """

    name = "mapping"
    Config = MappingConfig
    config: MappingConfig
    replaceable = hands_over = True
    # Few keyframes need to wait in memory: they also wait on this disk (with a session), or on the robot's.
    inputs = (
        Input("keyframes/frame", queued_bytes=32_000_000), Input("localization/anchors", "every"),
        Input("tick", "latest"),
    )  # fmt: skip
    outputs = (
        "keyframes/ack", "mapping/chunk", "mapping/anchors", "mapping/poses", "mapping/preview",
        "mapping/status",
    )  # fmt: skip
    _session: MapSession = NoSession()

    def check_resources(self) -> None:
        """Check the engine, the memory budget, and that the folders can be written."""
        c = self.config
        if c.engine == "cuda":
            check_cuda(OPTION)
        self._check_budgets()
        for option, folder in (("save", c.save), ("session", c.session)):
            if folder is not None:
                check_can_write(folder, option, read_only_disk=True)

    def configure(self) -> None:
        c = self.config
        self.writes_to = c.session
        warm()
        engine = make_engine(c.engine, c.threads, c.gpu_memory_mb, c.sh_degree)
        self.config = c = c.for_engine(engine.identity.name)
        self._mapper = Mapper(c.mapper_settings(), seed=c.seed, engine=engine)
        self._mapper.must_stop = self._must_pause
        self._now_ns = 0  # newest stamp that has arrived: the time of the data
        self._newest_keyframe_ns = 0  # that has arrived
        self._interruptible = self._interrupted = False  # owed steps, by the arrival of a keyframe
        self._intake = KeyframeIntake(self._mapper)
        self._feed = ChunkFeed()
        self._viewpoint = None
        self._backlog = 0
        self._check_budgets()
        if not self.in_standby:
            self.take_over()

    def _check_budgets(self) -> None:
        c = self.config
        if c.memory_mb is not None:
            check_budget(c.memory_mb, c.session)
        if c.gpu_memory_mb is not None:
            check_gpu_budget(c.engine, c.session)

    def options(self) -> MappingConfig:
        """Return the options with the defaults of the engine that computes here."""
        on_cpu = self.config.engine == "cpu" or cuda_obstacle() is not None
        return self.config.for_engine("cpu" if on_cpu else "cuda")

    def close(self) -> None:
        self._session.close()

    # --- hand-over ---

    def handover_obstacle(self, before: Node) -> str:
        """Return why the map of the node `before` cannot be taken over: both need the same session."""
        assert isinstance(before.config, MappingConfig)  # `before` is a node of this class
        own, other = self.config.session, before.config.session
        if other is None:
            return "the map is handed over in mapping.session, and the running mapper has none"
        if own is None or own.resolve() != other.resolve():
            return f"the map is in mapping.session = {other}, not in {own}"
        return super().handover_obstacle(before)

    def hand_over(self) -> None:
        """Save the map in the session and close the session, so that the successor can open it."""
        self._session.save()
        self._session.close()

    def take_over(self) -> None:
        """Open the session, if one is configured, and load the map from the session."""
        if self.config.session is not None:
            self._session = LiveSession(self.config, self._intake, self._report_progress)
            keyframes = len(self._intake.stored())
            self.detail = f"resumed with {keyframes} keyframes" if keyframes else ""

    def _report_progress(self, text: str) -> None:
        """Show the progress of opening the session; end it if the process must stop."""
        self.detail = text
        if self.must_stop():
            raise StopRequested

    # --- keyframes ---

    def on_header(self, header: Header) -> None:
        """Note how many keyframes wait on the robot."""
        if header.producer == "keyframes":
            self._backlog = header.backlog

    def on_arrival(self, topic: str, message: Message) -> Outputs:
        """Write a received keyframe to the session and acknowledge it, before it is processed."""
        if isinstance(message, Tick):
            self._now_ns = message.stamp_ns
        elif isinstance(message, Keyframe):
            self._now_ns = max(self._now_ns, message.stamp_ns)
            self._newest_keyframe_ns = max(self._newest_keyframe_ns, message.stamp_ns)
            self._interrupted = True
        if isinstance(self._session, NoSession) or not isinstance(message, Keyframe):
            return
        reason = self._intake.rejections.get(message.id)
        if reason is not None or self._session.accept(message):
            yield ack(message, reason or "ok")

    def on_keyframes_frame(self, message: Keyframe) -> Outputs:
        """Insert a keyframe, optimise as the delay allows, publish preview, status and chunk."""
        yield from self._take(message, from_disk=False)

    def _take(self, message: Keyframe, *, from_disk: bool) -> Outputs:
        acknowledged = self._session.start(message.id)
        known = self._mapper.was_inserted(message.id)
        load_visible = self._session.load_visible
        outcome = InsertionResult("ok") if known else self._intake.insert(message, load_visible)
        if not outcome.ok or (not acknowledged and self._session.store(message, known)):
            yield ack(message, outcome.status)
        if known:  # sent again while the acknowledgement was in transit
            return
        if not outcome.ok:
            self._intake.reject(message.id, outcome.status)
            self._session.remove(message.id)
            yield "mapping/status", self._status(message.stamp_ns, outcome, 0.0)
            return
        c, plan, delay_s = self.config, self._mapper.plan, (self._now_ns - message.stamp_ns) * 1e-9
        half, full = plan.at_once(delay_s, c.latency_s, c.half_steps, c.full_steps)
        loss = self._mapper.optimise(half, full)
        plan.owe("window", HALF, c.half_steps - half)
        plan.owe("window", FULL, c.full_steps - full)
        self._session.keep_budget()
        if delay_s < c.latency_s or message.stamp_ns >= self._newest_keyframe_ns:
            yield from self._show(message, outcome, loss)
            if len(self._mapper.keyframes) % c.chunk_every == 0:
                census = ChunkCensus(self._mapper, self._viewpoint)
                yield from self._chunk(census, message.anchor_id, message.stamp_ns)
        else:  # a newer one waits: its preview is shown, and ticks publish the chunk
            yield "mapping/status", self._status(message.stamp_ns, outcome, loss)
        if not from_disk:  # its stamp would be an old one, between new ones: a checkpoint each time
            yield from self._checkpoint(message.stamp_ns)

    def has_idle_work(self) -> bool:
        """Return whether steps are owed, or keyframes wait on the disk."""
        return (self._session.has_skipped or self._mapper.has_owed_steps) and not self.must_stop()

    def on_idle(self) -> Outputs:
        """Insert a keyframe that waits on the disk, else do a piece of the owed steps."""
        if self._session.has_skipped:
            yield from self._skipped()
            return
        self._interrupted, self._interruptible = False, True
        self._mapper.optimise_owed()
        self._interruptible = False
        self._report_owed()

    def _must_pause(self) -> bool:
        """Return whether the steps must end: with the process, or because a keyframe has arrived."""
        return self.must_stop() or (self._interruptible and self._interrupted)

    def _skipped(self) -> Outputs:
        """Insert one keyframe that waits on the disk."""
        for message in self._session.skipped():
            yield from self._take(message, from_disk=True)

    def _checkpoint(self, stamp_ns: int) -> Outputs:
        if (work := self._session.checkpoint(stamp_ns)) is not None:
            yield Job("checkpoint", work)

    def on_job_checkpoint(self, result: CheckpointResult) -> Outputs:
        self._session.finish_checkpoint(result)
        return iter(())

    # --- anchors and time ---

    def on_localization_anchors(self, anchors: Anchors) -> Outputs:
        """Move the Gaussians to the new anchor poses; later, steps close the gaps at submap borders."""
        if reason := self._intake.other_map(anchors.map_uuid):
            log.warning("anchors are ignored: %s", reason)
            return
        given = {int(a): T for a, T in zip(anchors.anchor_ids, anchors.T_map_anchor)}
        moved = self._intake.move_anchors(given)
        if moved and self._mapper.keyframes:
            # Viewers move the chunks that they have. What the steps change follows with the next chunks.
            yield "mapping/anchors", anchors_message(self._mapper, anchors.stamp_ns)
            self._session.anchors_moved()
            self._mapper.plan.mend(HALF, self.config.mend_steps)

    def on_tick(self, tick: Tick) -> Outputs:
        """Plan steps on the whole map, or insert a skipped keyframe; publish the due chunk that is oldest."""
        if self._session.has_skipped:
            yield from self._skipped()
        elif self._mapper.keyframes:
            if self._mapper.plan.count == 0:
                self._mapper.plan.owe("refine", FULL, self.config.tick_steps)
            self._session.keep_budget()
        if not self._mapper.keyframes:
            return
        census = ChunkCensus(self._mapper, self._viewpoint)
        oldest = self._feed.oldest_due(census)
        if oldest is not None:
            yield from self._chunk(census, oldest, tick.stamp_ns)
        yield from self._checkpoint(tick.stamp_ns)

    # --- end of the data ---

    def drain(self) -> Outputs:
        """Process all waiting keyframes, publish the map, refine it if configured, and write the files.

        If the process must stop, only write the files: waiting keyframes are on disk, or the robot sends them
        again.
        """
        if self.must_stop():
            if self._mapper.keyframes:
                yield from self._save()
            return
        self._session.end_of_input()
        while self._session.waiting and not self.must_stop():
            yield from self._skipped()
        while self._mapper.has_owed_steps and not self.must_stop():
            self._mapper.optimise_owed()
        if not self._mapper.keyframes:
            return
        yield from self._publish_all()
        if self.config.final_steps:
            self._mapper.refine(self.config.final_steps, FULL)
            yield from self._publish_all()
        yield from self._save()
