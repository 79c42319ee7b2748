"""The map of a running mapper, followed over a session of its own while somebody looks at it.

Nothing is subscribed to, kept or merged before the first request. `IDLE_S` after the last request, if no
viewer has an event stream open, the session is closed and the memory freed.
"""

from __future__ import annotations

import logging
import secrets
import threading
import time
from collections.abc import Callable
from functools import partial
from http import HTTPStatus

import numpy as np
import zenoh

from beamsplat.common.errors import UserError, reason
from beamsplat.common.geometry.transforms import quat_xyzw_from_matrix
from beamsplat.common.messages import Image, MapAnchors, MapChunk, MapPoses, MapRender, Message
from beamsplat.common.messages.header import DecodeError
from beamsplat.common.topics import Topic, topic
from beamsplat.common.zenoh.bus import key
from beamsplat.common.zenoh.queries import ask
from beamsplat.common.zenoh.receiving import receive_in_thread
from beamsplat.common.zenoh.streams import declare_subscription, decode_sample
from beamsplat.services.page.map3d.source import MapSource, MapUnavailable, MountedCamera, ViewRequest

log = logging.getLogger(__name__)

IDLE_S = 30.0  # after the last request or viewer
_TOPICS = ("mapping/chunk", "mapping/anchors")
_QUEUED = (
    64  # chunks on their way from the session to the map; a full ring loses the oldest, which comes again
)
_POLL_S = 0.1
_RETRY_S = 2.0  # after a query without an answer
_POSES_S = 2.0  # how often the poses of the keyframes are asked for at most, if the map has changed
_SNAPSHOT_S, _POSES_TIMEOUT_S, _IMAGE_S, _RENDER_S = 30.0, 5.0, 10.0, 15.0  # for an answer
_CONNECT_S = 5.0


class LiveMap(MapSource):
    """The map of one robot. Its thread exists while the map is `active`."""

    def __init__(
        self, robot: str, connect: Callable[[], zenoh.Session], instance: Callable[[], str],
        camera: Callable[[], MountedCamera | None], budget_mb: float, reject: Callable[[str], None],
    ) -> None:  # fmt: skip
        """Create the source; nothing is opened yet.

        Args:
            connect: opens a session; raises UserError.
            instance: returns the process of the mapper by its health, "" = none is known.
            camera: returns camera and mount of the robot, None = not known yet.
            budget_mb: for the packed Gaussians.
            reject: called with the reason for each chunk that cannot be used.
        """
        super().__init__(budget_mb)
        self.note = ""
        self._robot, self._connect, self._instance = robot, connect, instance
        self._mounted_camera, self._reject = camera, reject
        self._page = secrets.token_hex(4)  # revisions are counted by this object
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._session: zenoh.Session | None = None
        self._until_s = 0.0
        self._closed = False
        self._arrived = threading.Event()
        self._mapper = ""  # instance whose chunks are kept
        self._complete = False  # whether a snapshot has been received from it
        self._retry_s = self._poses_s = 0.0
        self._posed_revision = -1

    # --- called by the server ---

    def want(self) -> None:
        with self._lock:
            self._until_s = time.monotonic() + IDLE_S
            if self._thread is None and not self._closed:
                self._thread = threading.Thread(target=self._run, name=f"map3d-{self._robot}", daemon=True)
                self._thread.start()

    @property
    def active(self) -> bool:
        return self._thread is not None

    def close(self) -> None:
        with self._lock:
            self._closed = True
            thread = self._thread
        self._arrived.set()
        if thread is not None:
            thread.join(_CONNECT_S)

    def render(self, view: ViewRequest) -> bytes:
        x, y, z, w = quat_xyzw_from_matrix(view.T_map_camera[:3, :3])
        parameters = {
            "position": ",".join(f"{v:.9g}" for v in view.T_map_camera[:3, 3]),
            "quaternion": f"{x:.9g},{y:.9g},{z:.9g},{w:.9g}", "width_px": str(view.width_px),
            "height_px": str(view.height_px), "focal_px": f"{view.focal_px:.9g}",
        }  # fmt: skip
        answer = self._ask_mapper("render", parameters, _RENDER_S)
        if not isinstance(answer, MapRender):
            raise MapUnavailable("the mapper has sent no image")
        return answer.render.tobytes()

    def _read_image(self, id: int) -> bytes:
        try:
            answer = self._ask_mapper("keyframe", {"id": str(id)}, _IMAGE_S)
        except MapUnavailable as error:
            missing = "is not kept" in str(error)
            raise MapUnavailable(str(error), HTTPStatus.NOT_FOUND if missing else error.status) from error
        if not isinstance(answer, Image):
            raise MapUnavailable("the mapper has sent no image")
        return answer.data.tobytes()

    def _ask_mapper(self, name: str, parameters: dict[str, str], timeout_s: float) -> Message | None:
        """Return the first answer to a query. Raises MapUnavailable without one."""
        self.want()
        deadline = time.monotonic() + _CONNECT_S
        while (session := self._session) is None:
            if time.monotonic() > deadline or self._closed:
                raise MapUnavailable(self.note or "the page is connecting to the mapper: try again")
            time.sleep(0.05)
        try:
            return next(ask(session, self._robot, "mapping", name, parameters, timeout_s), None)
        except (UserError, zenoh.ZError) as error:
            raise MapUnavailable(reason(error)) from error

    # --- the thread ---

    def _run(self) -> None:
        try:
            session = self._connect()
        except UserError as error:
            self._say(reason(error))
            with self._lock:
                self._thread = None
            return
        with session:
            subscriber = self._subscribe(session)
            self._session = session
            while self._stays():
                self._follow(session)
                if not self.map.make_levels(time.monotonic()):
                    self._arrived.wait(_POLL_S)
                    self._arrived.clear()
            del subscriber

    def _subscribe(self, session: zenoh.Session) -> list[object]:
        """Subscribe to chunks and poses of anchors, until the result is deleted or the session closed."""
        declared: list[object] = []
        for row in map(topic, _TOPICS):
            channel: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(_QUEUED)
            subscriber = declare_subscription(session, key(self._robot, row.name), row, row.delivery, channel)
            receive_in_thread(session, f"map3d-{row.name}", subscriber, partial(self._handle, row))
            declared.append(subscriber)
        return declared

    def _stays(self) -> bool:
        """Return whether somebody still looks; else free everything."""
        with self._lock:
            if not self._closed and time.monotonic() < self._until_s:
                return True
            self._thread = self._session = None
            self._start_map("")
            return False

    def _start_map(self, instance: str) -> None:
        """Begin with an empty map, of another process."""
        self._mapper, self._complete, self._posed_revision = instance, False, -1
        self._retry_s = self._poses_s = 0.0
        self.keyframes = {}
        self.forget_images()
        self.map.start_over(f"{instance}-{self._page}" if instance else "")

    def _say(self, note: str) -> None:
        if note != self.note:
            self.note = note
            self.map.touch()

    def _follow(self, session: zenoh.Session) -> None:
        """Ask the mapper for the whole map when its process is a new one, and for the keyframes' poses."""
        instance, now = self._instance(), time.monotonic()
        if not instance:
            self._say("no mapper is running")
            return
        if instance != self._mapper:
            self._start_map(instance)
        if not self._complete and now >= self._retry_s:
            self._retry_s = now + _RETRY_S
            self._take_snapshot(session)
        if self._complete and now >= self._poses_s and self.map.revision != self._posed_revision:
            self._poses_s = now + _POSES_S
            self._take_poses(session)

    def _take_snapshot(self, session: zenoh.Session) -> None:
        try:
            for chunk in ask(session, self._robot, "mapping", "snapshot", {}, _SNAPSHOT_S):
                if isinstance(chunk, MapChunk):
                    self._put(chunk)
            self._complete = True
            self._say("")
        except (UserError, zenoh.ZError) as error:
            self._say(reason(error))

    def _take_poses(self, session: zenoh.Session) -> None:
        mounted, before = self._mounted_camera(), self.map.revision
        if mounted is None:
            return
        try:
            (poses,) = ask(session, self._robot, "mapping", "poses", {}, _POSES_TIMEOUT_S)
        except (UserError, ValueError, zenoh.ZError) as error:  # a mapper of an earlier version
            log.info("poses of keyframes: %s", reason(error))
            return
        if not isinstance(poses, MapPoses):
            return
        T_map_camera = poses.T_map_body @ mounted.T_body_camera
        self.keyframes = dict(zip(poses.keyframe_ids.tolist(), T_map_camera))
        self.camera = mounted.shown
        self.map.touch()
        self._posed_revision = before + 1  # what changes meanwhile is asked for again

    def _handle(self, row: Topic, sample: zenoh.Sample) -> None:
        """Take a published chunk or the poses of anchors; called from threads of the session."""
        try:
            envelope = decode_sample(sample, row)
        except DecodeError:
            self._reject("chunks of the 3D map: not decodable")
            return
        # Messages of a new mapper are taken once its health report was accepted. The snapshot that is then
        # requested contains what it published before.
        if envelope.header.instance != self._mapper:
            return
        message = envelope.message
        if isinstance(message, MapChunk):
            self._put(message)
        elif isinstance(message, MapAnchors):
            poses = dict(zip(message.anchor_ids.tolist(), message.T_map_anchor))
            self.map.move(poses, message.pose_revision)
        self._arrived.set()

    def _put(self, chunk: MapChunk) -> None:
        try:
            self.map.put(
                chunk.anchor_id, chunk.revision, np.asarray(chunk.T_map_anchor), chunk.cell_m,
                chunk.packed.tobytes(), chunk.pose_revision,
            )  # fmt: skip
        except ValueError:
            self._reject("chunks of the 3D map: not packed Gaussians")
