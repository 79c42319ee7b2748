"""Insertion of keyframe messages into the mapper, and records: inserted and rejected ids, map UUID."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import lru_cache

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.camera import Undistorter
from beamsplat.common.geometry.transforms import inverse
from beamsplat.common.messages import Keyframe
from beamsplat.common.messages.map import ODOM_ORIGIN
from beamsplat.services.mapping.keyframe import StoredKeyframe
from beamsplat.services.mapping.mapper import InsertionResult, Mapper
from beamsplat.services.mapping.messages import decode_keyframe

log = logging.getLogger("beamsplat.mapping")

_MAX_REJECTIONS = 10_000  # reasons stored; a keyframe that is sent again later is examined again

LoadVisible = Callable[[StoredKeyframe], None]  # pages in the Gaussians that a keyframe observes


class KeyframeIntake:
    """Inserts keyframe messages into a mapper; stores their stamps, camera mountings and rejections."""

    def __init__(self, mapper: Mapper) -> None:
        self.mapper = mapper
        self.undistorter = lru_cache(maxsize=4)(Undistorter)  # remapping tables, one per calibration
        self.rejections: dict[int, str] = {}  # keyframe id -> reason
        self.map_uuid = ""  # of the robot's map to which this one is anchored; "" = not known yet
        self._inserted: dict[int, tuple[int, np.ndarray]] = {}  # keyframe id -> stamp_ns, T_camera_body
        self._T_oldest_origin: np.ndarray | None = None  # pose of the odom origin in the oldest submap

    def knows(self, id: int) -> bool:
        """Return whether a keyframe was inserted, now or in an earlier process."""
        return id in self._inserted or self.mapper.was_inserted(id)

    def insert(self, message: Keyframe, load_visible: LoadVisible | None = None) -> InsertionResult:
        """Decode a keyframe and insert it; `status` of the result is "ok", or why it was not inserted."""
        if reason := self.other_map(message.map_uuid):
            return InsertionResult(reason)
        try:
            frame = decode_keyframe(message, self.undistorter)
        except (UserError, ValueError) as error:
            return InsertionResult(str(error))
        m = self.mapper
        outcome = m.add(frame, message.T_map_anchor, load_visible)
        if outcome.ok:
            self._inserted[message.id] = (message.stamp_ns, inverse(message.camera.T_body_camera))
            if len(self._inserted) > len(m.keyframes) + len(m.paged_out):  # the mapper has dropped some
                self._inserted = {id: entry for id, entry in self._inserted.items() if m.contains(id)}
        return outcome

    def reject(self, id: int, reason: str) -> None:
        """Store and log the reason why a keyframe was not inserted."""
        self.rejections[id] = reason
        if len(self.rejections) > _MAX_REJECTIONS:
            del self.rejections[next(iter(self.rejections))]
        log.warning("keyframe %d is rejected: %s", id, reason)

    def other_map(self, uuid: str) -> str:
        """Return why data of the robot's map `uuid` cannot be used, "" if usable.

        The first non-empty UUID becomes the UUID of this map.
        """
        if uuid and self.map_uuid and uuid != self.map_uuid:
            return (
                f"it belongs to the robot's map {uuid[:8]}, this map to {self.map_uuid[:8]}: start "
                "localization with localization.resume, or the mapper with another session"
            )
        self.map_uuid = uuid or self.map_uuid
        return ""

    def move_anchors(self, T_map_anchor: dict[int, np.ndarray]) -> list[int]:
        """Set new poses of anchors; Gaussians and keyframes move with their anchors.

        Keyframes anchored to the odom origin move with the oldest submap, which was started there.

        Returns:
            The ids of all anchors that were passed (and of the odom origin), or [] if no pose has changed.
        """
        poses = dict(T_map_anchor)
        origin = self.mapper.T_map_anchor.get(ODOM_ORIGIN)
        if origin is not None and poses:
            T_map_oldest = poses[min(poses)]
            if self._T_oldest_origin is None:
                self._T_oldest_origin = inverse(T_map_oldest) @ origin
            poses[ODOM_ORIGIN] = T_map_oldest @ self._T_oldest_origin
        return list(poses) if self.mapper.move_anchors(poses) else []

    def stored(self) -> dict[int, StoredKeyframe]:
        """Return all keyframes of the map by id, including keyframes that are paged out to disk."""
        return self.mapper.keyframes | self.mapper.paged_out

    def poses(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return (stamps_ns int64 [K] ascending, refined T_map_body float64 [K, 4, 4], ids int64 [K])."""
        stored = self.stored()
        ids = sorted(stored, key=lambda id: (self._inserted[id][0], id))
        T_map_body = np.array([self.mapper.T_map_camera(stored[id]) @ self._inserted[id][1] for id in ids])
        stamps_ns = np.array([self._inserted[id][0] for id in ids], np.int64)
        return stamps_ns, T_map_body, np.array(ids, np.int64)

    # --- as arrays, beside the mapper's own state ---

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the records of inserted keyframes and the map UUID as arrays, for a checkpoint."""
        ids = list(self._inserted)
        origin = [] if self._T_oldest_origin is None else [self._T_oldest_origin]
        return {
            "taken_id": np.array(ids, np.int64),
            "taken_stamp_ns": np.array([self._inserted[id][0] for id in ids], np.int64),
            "taken_T_camera_body": np.array([self._inserted[id][1] for id in ids]).reshape(-1, 4, 4),
            "T_oldest_origin": np.array(origin).reshape(-1, 4, 4),
            "map_uuid": np.array([self.map_uuid]),
        }

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Restore the records from the result of `arrays` of an earlier process; no effect if empty."""
        if not arrays:
            return
        rows = zip(arrays["taken_stamp_ns"].tolist(), arrays["taken_T_camera_body"])
        self._inserted = dict(zip(arrays["taken_id"].tolist(), rows))
        self._T_oldest_origin = next(iter(arrays["T_oldest_origin"]), None)
        self.map_uuid = str(next(iter(arrays.get("map_uuid", [])), ""))
