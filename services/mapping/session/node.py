"""What of the mapping service outlives its process: the map and its keyframes, in a session on disk."""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np

from beamsplat.common.geometry.camera import Pinhole, Undistorter
from beamsplat.common.geometry.transforms import inverse
from beamsplat.common.messages import Keyframe, Message
from beamsplat.common.messages.codec import decode
from beamsplat.common.runtime.node import Job, Node, Outputs
from beamsplat.services.mapping.config import MappingConfig
from beamsplat.services.mapping.keyframe import Keyframe as MapKeyframe
from beamsplat.services.mapping.mapper import Mapper, Outcome
from beamsplat.services.mapping.messages import ack, body_of, open_keyframe
from beamsplat.services.mapping.session.checkpointer import Keeper, Saved
from beamsplat.services.mapping.session.inbox import Arrivals

log = logging.getLogger("beamsplat.mapping")


class SessionNode(Node):
    """The mapping node's part that saves, resumes and hands over; without a session it does nothing."""

    replaceable = hands_over = True
    config: MappingConfig
    _keeper: Keeper | None = None
    _arrivals: Arrivals | None = None
    _mapper: Mapper
    _lens: Callable[[Pinhole], Undistorter]
    _take: Callable[[Keyframe], Outcome]  # these two are the mapping node's own
    on_keyframes_frame: Callable[[Keyframe], Outputs]
    _taken: dict[int, tuple[int, np.ndarray]]  # keyframe -> stamp_ns, T_camera_body
    _refusals: dict[int, str]
    _T_oldest_origin: np.ndarray | None
    _resumed: frozenset[int] | set[int] = frozenset()  # taken from the disk in a predecessor's place
    _map_uuid: str = ""  # of the robot's map that this one hangs on

    def close(self) -> None:
        if self._keeper is not None:
            self._keeper.close()

    def obstacle(self, before: Node) -> str:
        """The map goes along in the session, so there must be one, and both must mean the same."""
        mine, its = self.config.session, before.config.session
        if its is None:
            return "its map goes along in mapping.session, and it was started without one"
        if mine is None or mine.resolve() != its.resolve():
            return f"its map is in mapping.session = {its}, not in {mine}"
        return super().obstacle(before)

    def hand_over(self) -> None:
        """All that is known goes into the session, which another may write to from now on."""
        if self._mapper.keyframes:
            self._keeper.save(self._mapper, self._extra())
        self._keeper.close()

    def take_over(self) -> None:
        c = self.config
        if c.session is not None:
            budget_bytes = None if c.memory_mb is None else c.memory_mb * 1e6
            self._keeper = Keeper(c.session, round(c.session_every_s * 1e9), budget_bytes, c.seed)
            self._resume(self._keeper)
            self._arrivals = Arrivals(self._keeper)

    def on_arrival(self, topic: str, message: Message) -> Outputs:
        """A keyframe is acknowledged before its turn comes, if it is to survive this process and does."""
        if self._arrivals is None or not isinstance(message, Keyframe) or message.id in self._resumed:
            return
        status = self._refusals.get(message.id)
        known = message.id in self._taken or self._mapper.knows(message.id)
        if status is not None or self._arrivals.take(message.id, known, lambda: body_of(message)):
            yield ack(message, status or "ok")

    def _refuse(self, id: int, why: str) -> None:
        self._refusals[id] = why
        if self._keeper is not None:
            self._keeper.drop(id)
        log.warning("keyframe %d is refused: %s", id, why)

    def _overtaken(self) -> Outputs:
        """One keyframe from the disk that the mailbox had no room for."""
        if (body := self._arrivals.overtaken()) is not None:
            yield from self.on_keyframes_frame(decode(*body))

    def _resume(self, keeper: Keeper) -> None:
        """Becomes what was saved; keyframes that came after the checkpoint are taken in again."""
        m = self._mapper
        extra, newer = keeper.resume(m, lambda schema, body: open_keyframe(decode(schema, body), self._lens))
        if extra:
            rows = zip(extra["taken_stamp_ns"].tolist(), extra["taken_T_camera_body"])
            self._taken = dict(zip(extra["taken_id"].tolist(), rows))
            self._T_oldest_origin = next(iter(extra["T_oldest_origin"]), None)
            self._map_uuid = str(next(iter(extra.get("map_uuid", [])), ""))
        if self.in_standby:  # its predecessor has acknowledged these; they wait here as well
            self._resumed = set(newer)
        for id in newer:
            body = keeper.body(id)
            if body is None:
                continue
            message = decode(*body)
            keeper.count_from(message.stamp_ns)  # killed again and again, it still comes to a checkpoint
            outcome = self._take(message)
            if outcome.ok:
                self._mapper.optimise()
            else:
                self._refuse(id, outcome.status)
        if m.keyframes:
            log.info("goes on with %d keyframes (%d came after the checkpoint), %d Gaussians, step %d",
                     len(m.keyframes), len(newer), m.store.count, m.steps)  # fmt: skip

    def _extra(self) -> dict[str, np.ndarray]:
        """What of this node outlives it, beside the mapper."""
        ids = list(self._taken)
        origin = [] if self._T_oldest_origin is None else [self._T_oldest_origin]
        return {
            "taken_id": np.array(ids, np.int64),
            "taken_stamp_ns": np.array([self._taken[id][0] for id in ids], np.int64),
            "taken_T_camera_body": np.array([self._taken[id][1] for id in ids]).reshape(-1, 4, 4),
            "T_oldest_origin": np.array(origin).reshape(-1, 4, 4),
            "map_uuid": np.array([self._map_uuid]),
        }

    def _add(self, frame: MapKeyframe, message: Keyframe) -> Outcome:
        """Into the map, with what it sees in memory; what is known of keyframes given up for it goes."""
        keeper, m = self._keeper, self._mapper
        bring = None if keeper is None else lambda held: keeper.bring(m, held)
        outcome = m.add(frame, message.T_map_anchor, bring)
        if outcome.ok:
            self._taken[message.id] = (message.stamp_ns, inverse(message.camera.T_body_camera))
            if len(self._taken) > len(m.keyframes) + len(m.resting):
                self._taken = {id: taken for id, taken in self._taken.items() if m.holds(id)}
        return outcome

    def _foreign(self, uuid: str) -> str:
        """Why what hangs on anchors of that map cannot be taken; "" if it can. The first names this one's."""
        if uuid and self._map_uuid and uuid != self._map_uuid:
            return (
                f"of the robot's map {uuid[:8]}, this one hangs on {self._map_uuid[:8]}: start localization "
                "with localization.resume, or the mapper with another session"
            )
        self._map_uuid = uuid or self._map_uuid
        return ""

    def _page(self) -> None:
        """The memory's budget is kept."""
        if self._keeper is not None:
            self._keeper.page(self._mapper)

    def _checkpoint(self, stamp_ns: int) -> Outputs:
        """Now and then the map goes to the disk, in the background."""
        if self._keeper is not None and self._mapper.keyframes and self._keeper.due(stamp_ns):
            yield Job("checkpoint", self._keeper.checkpoint(self._mapper, self._extra(), stamp_ns))

    def on_job_checkpoint(self, saved: Saved) -> Outputs:
        self._keeper.done(saved)
        return iter(())
