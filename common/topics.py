"""THE dataflow: every topic, its message, who may produce it, its rate and how it is delivered.

Change this table first. Deliveries are the default of a subscription, which may choose otherwise:

latest   a ring of one: the newest wins, the writer never waits, what is overtaken is counted
every    in order; `cache` messages are kept by the publisher, so that a subscriber recovers what a
         broken link lost; what is lost for good is counted
latched  the last value reaches late joiners

`uplink` marks what crosses between a robot and its edge server (common/relay.py): "up" from the robot, "bulk"
likewise but large, on a link of its own behind the small, "down" to the robot. A topic has exactly one
producer in a running system; where several services are named, a deployment starts one of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from beamsplat.common import messages as m

Delivery = Literal["latest", "every", "latched"]
Uplink = Literal["", "up", "bulk", "down"]


LIMIT_KB = 32_000  # of any message; a router that takes links from other hosts lets nothing larger in
_LIMITS_KB = {  # of what comes from other hosts
    "rig": 100, "localization/odometry": 64, "localization/correction": 64, "localization/anchors": 4000,
    "localization/grid": 16_000, "keyframes/frame": 8000, "keyframes/ack": 16, "tick": 16, "health": 64,
}  # fmt: skip


@dataclass(frozen=True)
class Topic:
    """One row of the table."""

    name: str
    message: type[m.Message]
    producers: tuple[str, ...]
    rate_hz: float  # nominal; 0 = on events
    delivery: Delivery
    cache: int = 0  # messages the publisher keeps for recovery: rate x longest outage to survive
    uplink: Uplink = ""
    repeated: bool = False  # until it is acknowledged: a gap is no loss

    @property
    def handler(self) -> str:
        """Name of the node method that takes this topic: camera/image -> on_camera_image."""
        return "on_" + self.name.replace("/", "_")

    @property
    def limit_kb(self) -> int:
        """A larger message is none of ours: refused before it is decoded, and counted."""
        return _LIMITS_KB.get(self.name, LIMIT_KB)


_ROWS = (
    # name                    message          producers                 Hz  delivery  cache  uplink  repeated
    Topic("rig",                     m.Rig,           ("camera", "ros2", "replay"), 0, "latched", 1, "up"),
    Topic("wheel/odometry",          m.WheelOdometry, ("wheels", "ros2", "replay"), 50, "every", 2000),
    Topic("lidar/scan",              m.Scan,          ("lidar", "ros2", "replay"), 10, "every", 400),
    Topic("camera/image",            m.Image,         ("camera", "ros2", "replay"), 10, "latest"),
    Topic("external/pose",           m.ExternalPose,  ("ros2", "replay"),       10, "every", 400),
    Topic("localization/odometry",   m.Odometry,      ("localization",),        10, "every", 400, "up"),
    Topic("localization/correction", m.Correction,    ("localization",),         0, "latched", 1, "up"),
    Topic("localization/anchors",    m.Anchors,       ("localization",),         0, "latched", 1, "up"),
    Topic("localization/movers",     m.MovingBeams,   ("localization",),        10, "every", 400),
    Topic("localization/grid",       m.Grid,          ("localization",),         0, "latched", 1, "bulk"),
    Topic("depth/estimate",          m.DepthEstimate, ("depth",),                5, "latest"),
    Topic("fusion/depth",            m.FusedDepth,    ("fusion",),               5, "latest"),
    Topic("fusion/cloud",            m.Cloud,         ("fusion",),               1, "latest"),
    Topic("keyframes/frame",         m.Keyframe,      ("keyframes",),           2, "every", 60, "bulk", True),
    Topic("keyframes/ack",           m.KeyframeAck,   ("mapping",),              2, "every", 60, "down"),
    Topic("mapping/chunk",           m.MapChunk,      ("mapping",),              2, "every", 60),
    Topic("mapping/poses",           m.MapPoses,      ("mapping",),              0, "latched", 1),
    Topic("mapping/preview",         m.MapPreview,    ("mapping",),              2, "latest"),
    Topic("mapping/status",          m.MapStatus,     ("mapping",),              2, "every", 60),
    Topic("tick",                    m.Tick,          ("clock", "replay"),      1, "every", 60, "up"),
)  # fmt: skip

TOPICS: dict[str, Topic] = {row.name: row for row in _ROWS}
ROW_NUMBER: dict[str, int] = {row.name: i for i, row in enumerate(_ROWS)}

# Not part of the dataflow: each node reports its own health under health/<node>.
HEALTH = "health"


def topic(name: str) -> Topic:
    """The row called `name`.

    Raises:
        KeyError: no such topic; the text lists those there are.
    """
    if name not in TOPICS:
        raise KeyError(f"no topic called {name!r}; there are {', '.join(TOPICS)}")
    return TOPICS[name]
