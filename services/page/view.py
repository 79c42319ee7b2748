"""State of the running system, as JSON for the page.

The node's thread writes the state, the server's thread reads it.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from beamsplat.common.geometry.tracks import BoundedPath, PoseBuffer, scan_points
from beamsplat.common.geometry.transforms import transform_points, yaw_of
from beamsplat.common.runtime.health import HealthRecords, NodeRecord
from beamsplat.services.page.images import LatestImage
from beamsplat.services.page.map3d.source import MountedCamera

# Sources of the robot's pose, best first; the best available one is shown.
SOURCES = ("localization", "external", "wheel")
IMAGE_NAMES = ("camera", "depth", "render", "map")
_PATH_POINTS, _PATH_STEP_M = 400, 0.05
_SCAN_POINTS = 360  # of a scan that are sent at most
_MAX_WAITING_SCANS = 30  # scans kept until their pose is known
_MAX_SCALES = 120  # seconds of the scale chart: one value per second
_LOG_LINES = 60
_T = TypeVar("_T")


class PageState:
    """The newest message of each input; every method may be called from any thread."""

    def __init__(self, picture_hz: float, map_hz: float) -> None:
        self._lock = threading.Lock()
        self.heard_s = time.monotonic()  # when the newest message of the robot arrived
        self._health = HealthRecords()
        self._silent_nodes: set[str] = set()
        self._log: deque[dict[str, Any]] = deque(maxlen=_LOG_LINES)
        self._services: dict[str, dict[str, Any]] = {}
        self._scales: deque[tuple[float, float, float]] = deque(maxlen=_MAX_SCALES)
        self._T_body_lidar = np.eye(4)
        self.camera: MountedCamera | None = None
        self._T_map_odom = np.eye(4)
        self._source_rank = len(SOURCES)
        self._poses = PoseBuffer()  # T_map_body of the best source
        self._received_s = 0.0
        self._path = BoundedPath(_PATH_POINTS, _PATH_STEP_M)
        self._scans: deque[tuple[int, np.ndarray]] = deque(maxlen=_MAX_WAITING_SCANS)  # stamp, lidar frame
        self.images = {name: LatestImage(map_hz if name == "map" else picture_hz) for name in IMAGE_NAMES}

    # --- written by the node ---

    def health(self, health: Any) -> None:
        """Store the health of a node (message `Health`); log changes of its state, and restarts."""
        with self._lock:
            before = self._health.records.get(health.node)
            instance, state = (before.health.instance, before.health.state) if before else ("", "")
            if not self._health.add(health):  # of another process than the accepted one
                return
            self._silent_nodes.discard(health.node)
            if before and instance != health.instance:
                self._log_event(f"{health.node} was restarted")
            if state != health.state:
                self._log_event(f"{health.node} is {health.state}")

    def service_status(self, subject: str, status: str, **facts: Any) -> None:
        """Store the status of a service's newest result; log it if it has changed."""
        with self._lock:
            before = self._services.get(subject, {}).get("status")
            self._services[subject] = {"status": status, "at": time.monotonic(), **facts}
            if before != status:
                self._log_event(f"{subject}: {status}")

    def scale(self, value: float, sigma: float) -> None:
        """Store the depth scale and its standard error; at most one value per second is stored."""
        now = time.monotonic()
        with self._lock:
            if math.isfinite(value) and (not self._scales or now - self._scales[-1][0] >= 1.0):
                self._scales.append((now, value, sigma))

    def lidar(self, T_body_lidar: np.ndarray) -> None:
        """Store the lidar's mount `T_body_lidar` [4, 4]."""
        self._T_body_lidar = T_body_lidar

    def correction(self, T_map_odom: np.ndarray) -> None:
        """Store the pose of the odom frame in the map, `T_map_odom` [4, 4]."""
        self._T_map_odom = T_map_odom

    def pose(self, source: str, stamp_ns: int, T_source_body: np.ndarray) -> None:
        """Store the robot's pose [4, 4] from `source`; ignore sources worse than the best one so far.

        Poses of localization are in the odom frame, external poses in the map frame. While there are only
        wheel poses, their own frame is used as the map frame.
        """
        rank = SOURCES.index(source)
        with self._lock:
            if rank > self._source_rank:
                return
            if rank < self._source_rank:
                self._source_rank, self._poses = rank, PoseBuffer()
            T_map_body = self._T_map_odom @ T_source_body if source == "localization" else T_source_body
            self._poses.add(stamp_ns, T_map_body)
            self._received_s = time.monotonic()
            self._path.add(T_map_body[:3, 3])

    def scan(
        self,
        stamp_ns: int,
        ranges_m: np.ndarray,  # float32 [N]
        angle_min_rad: float,
        angle_increment_rad: float,
        range_limits_m: tuple[float, float],
    ) -> None:
        """Store a scan, to be drawn in the map when the pose at its stamp is known."""
        points, _ = scan_points(ranges_m, angle_min_rad, angle_increment_rad, range_limits_m)
        points = points[:: max(-(-len(points) // _SCAN_POINTS), 1)]
        with self._lock:
            self._scans.append((stamp_ns, points))

    def _newest_scan(self) -> tuple[np.ndarray, np.ndarray]:
        """Return T_map_lidar [4, 4] and points [N, 3] (m, lidar frame) of the newest scan whose pose is
        known; without one, no points."""
        newest_ns, _ = self._poses.newest
        for stamp_ns, points_lidar in reversed(self._scans):
            if stamp_ns <= newest_ns and (T_map_body := self._poses.at(stamp_ns)) is not None:
                return T_map_body @ self._T_body_lidar, points_lidar
        return np.eye(4), np.zeros((0, 3))

    def log_event(self, text: str) -> None:
        """Add a line to the events that the page lists."""
        with self._lock:
            self._log_event(text)

    def _log_event(self, text: str) -> None:
        self._log.append({"at": time.time(), "text": text})

    # --- read by the server ---

    def status(self) -> dict[str, Any]:
        """Return nodes, links, the status of the services, images and log, as data for JSON."""
        now = time.monotonic()
        with self._lock:
            self._silent_nodes &= self._health.records.keys()
            for name, record in self._health.records.items():
                if record.silent_s(now) and name not in self._silent_nodes:
                    self._silent_nodes.add(name)
                    self._log_event(f"{name} is silent")
            return {
                "nodes": [_node(n, r, now) for n, r in sorted(self._health.records.items())],
                "links": [_link(flow) for flow in self._health.traffic()],
                "words": {
                    subject: {"age_s": round(now - word["at"], 1), **_json_values(word)}
                    for subject, word in self._services.items()
                },
                "pictures": {
                    name: {"age_s": round(now - image.received_s, 1), "fault": image.fault}
                    for name, image in self.images.items()
                    if image.number
                },
                "log": list(self._log),
            }

    def with_records(self, use: Callable[[dict[str, NodeRecord]], _T]) -> _T:
        """Return `use(records)`: the newest health by node name, which does not change meanwhile."""
        with self._lock:
            return use(self._health.records)

    def summary(self) -> dict[str, Any]:
        """Return one robot's line of the fleet page, as data for JSON.

        `localization`: status of the newest pose ("" = none yet), "silent", or "none" without such a node;
        `map`: number of the newest image of the map, 0 = there is none.
        """
        now = time.monotonic()
        with self._lock:
            records = self._health.records
            states = self._health.states(now)
            running = sum(state not in ("silent", "failed") for state in states.values())
            pose = records.get("localization")
            if pose is None:
                localization = "none"
            else:
                localization = pose.health.status if pose.silent_s(now) is None else "silent"
            return {
                "age_s": round(now - self.heard_s, 1), "nodes": len(states), "running": running,
                "localization": localization,
                "link": _link_state(records, now),
                "keyframes": _figure(records, "map_keyframes", now),
                "gaussians": _figure(records, "map_gaussians", now),
                "outbox": _figure(records, "outbox_keyframes", now),
                "map": self.images["map"].newest,
            }  # fmt: skip

    def scales(self) -> list[list[float | None]]:
        """Return [[age s, depth scale, standard error], ...], oldest first."""
        now = time.monotonic()
        with self._lock:
            return [[round(now - at, 1), _json_number(v, 5), _json_number(s, 5)] for at, v, s in self._scales]

    def robot(self) -> dict[str, Any] | None:
        """Return the robot's pose in the map frame and the newest scan; None before the first pose.

        `scan_cm` contains the points of the scan as x, y, x, y ... in the map frame, cm.
        """
        with self._lock:
            if not self._poses:
                return None
            T, scan_m = self._poses.newest[1], transform_points(*self._newest_scan())
            return {
                "source": SOURCES[self._source_rank], "age_s": round(time.monotonic() - self._received_s, 1),
                "x_m": round(float(T[0, 3]), 3), "y_m": round(float(T[1, 3]), 3),
                "yaw_rad": round(float(yaw_of(T)), 4), "scan_cm": _centimetres(scan_m),
            }  # fmt: skip

    def scan3d(self) -> dict[str, Any] | None:
        """Return T_map_lidar and the points [x, y] (m, lidar frame) of the newest scan; None before it."""
        with self._lock:
            if not self._poses:
                return None
            T_map_lidar, points = self._newest_scan()
            return {
                "T_map_lidar": np.round(T_map_lidar, 5).ravel().tolist(),
                "points": np.round(points[:, :2], 3).tolist(),
            }

    def mapper_instance(self) -> str:
        """Return the id of the mapper's process by its newest health, "" before the first."""
        with self._lock:
            record = self._health.records.get("mapping")
            return "" if record is None else record.health.instance

    def path(self) -> list[int]:
        """Return the robot's path in the map frame as x, y, x, y ... in cm."""
        with self._lock:
            return _centimetres(self._path.points_m)


def _centimetres(points_m: np.ndarray) -> list[int]:
    return np.round(points_m[:, :2] * 100.0).astype(int).ravel().tolist()


def _node(name: str, record: NodeRecord, now: float) -> dict[str, Any]:
    health, totals, silent_s = record.health, record.totals(), record.silent_s(now)
    return {
        "name": name, "state": "silent" if silent_s else health.state, "starts": record.starts,
        "silent_s": round(silent_s or 0.0), "detail": health.detail,
        "in_hz": round(totals.in_hz, 1), "out_hz": round(totals.out_hz, 1), "age_ms": round(totals.age_ms, 1),
        "step_ms": round(health.step_p50_ms, 1), "p95_ms": round(health.step_p95_ms, 1),
        "dropped": totals.dropped, "lost": totals.lost, "late": totals.late,
        "bad": totals.bad + record.refused,
        "rss_mb": round(health.rss_mb), "cpu_percent": round(health.cpu_percent),
    }  # fmt: skip


def _figure(records: dict[str, NodeRecord], name: str, now: float) -> float | None:
    """Return a figure of the node that reports it, None if no node does."""
    heard = (record for record in records.values() if record.silent_s(now) is None)
    return next((value for record in heard if (value := record.figure(name)) is not None), None)


def _link_state(records: dict[str, NodeRecord], now: float) -> str:
    """Return the state of the uplink of a robot: "up", "down", or "none" if it has none."""
    known = [record for record in records.values() if record.figure("link_up") is not None]
    if not known:
        return "none"
    return "up" if any(r.silent_s(now) is None and r.figure("link_up") for r in known) else "down"


def _link(flow: Any) -> dict[str, Any]:
    return {
        "topic": flow.topic, "from": flow.producer, "hz": round(flow.hz, 1), "nominal_hz": flow.nominal_hz,
        "kb_s": round(flow.bytes_s / 1e3, 1), "sent": flow.sent,
        "to": [{**consumer._asdict(), "age_ms": round(consumer.age_ms, 1)} for consumer in flow.consumers],
    }  # fmt: skip


def _json_values(facts: dict[str, Any]) -> dict[str, Any]:
    return {k: _json_number(v, 5) if isinstance(v, float) else v for k, v in facts.items() if k != "at"}


def _json_number(value: float, digits: int) -> float | None:
    """Return a rounded number; None for NaN and infinity, which JSON does not have."""
    return round(value, digits) if math.isfinite(value) else None
