"""The topic table: each topic with its message type, producers, rate and delivery. It defines the dataflow.

Change this table first. `delivery` is the default of a subscription; a subscriber may choose another one:

latest   a ring buffer of one message: the publisher never waits; replaced messages are counted as dropped
every    in order; the publisher caches `cache` messages, so that a subscriber recovers what a broken link
         lost; messages that cannot be recovered are counted as lost
latched  late-joining subscribers receive the last message

`history` marks `every` topics of parts that together form a state (tiles of a grid): late-joining subscribers
receive the cached messages too, messages are handled in order of arrival (not merged with other topics by
stamp), and a gap is not a loss, because the producer sends the parts again, at the latest before they leave
the cache.

`thinned` marks topics of which the bridge forwards fewer messages while the robot stands still
(common/zenoh/thinning.py): for subscribers on the other host, a gap is not a loss.

`uplink` marks the topics that the bridge forwards between a robot and its edge server
(common/zenoh/bridge.py): "up" from the robot; "bulk" also from the robot, but large, on a separate link with
lower priority; "down" to the robot. A running system has exactly one producer per topic; where several
services are listed, a deployment starts one of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from beamsplat.common import messages as m

Delivery = Literal["latest", "every", "latched"]
Uplink = Literal["", "up", "bulk", "down"]


# Maximum message size in kB. A router that accepts links from other hosts drops larger messages.
LIMIT_KB = 32_000
# Smaller limits for the topics that other hosts publish: a few times the largest message of each.
_LIMITS_KB = {
    "rig": 100, "localization/odometry": 64, "localization/correction": 64, "localization/anchors": 4000,
    "localization/grid": 1100, "keyframes/frame": 8000, "keyframes/ack": 16, "tick": 16, "health": 64,
}  # fmt: skip


@dataclass(frozen=True)
class Topic:
    """One row of the topic table."""

    name: str
    message: type[m.Message]
    producers: tuple[str, ...]
    rate_hz: float  # nominal; 0 = published on events
    delivery: Delivery
    cache: int = 0  # messages that the publisher keeps for recovery: rate x longest outage to survive
    uplink: Uplink = ""
    # The producer sends each message again until it is acknowledged: a gap in the sequence is not a loss.
    resent_until_ack: bool = False
    history: bool = False
    thinned: bool = False

    @property
    def gaps_are_filled(self) -> bool:
        """Return whether the producer sends what was missed again: a gap counts as dropped, not as lost."""
        return self.resent_until_ack or self.history

    @property
    def handler(self) -> str:
        """Name of the node method that handles this topic: camera/image -> on_camera_image."""
        return "on_" + self.name.replace("/", "_")

    @property
    def limit_kb(self) -> int:
        """Maximum size of a message in kB; larger ones are rejected before decoding and counted."""
        return _LIMITS_KB.get(self.name, LIMIT_KB)


_ROWS = (
    # name                    message          producers                 Hz  delivery  cache  uplink  resent
    Topic("rig",                     m.Rig,           ("camera", "ros2", "replay"), 0, "latched", 1, "up"),
    Topic("wheel/odometry",          m.WheelOdometry, ("wheels", "ros2", "replay"), 50, "every", 2000),
    Topic("lidar/scan",              m.Scan,          ("lidar", "ros2", "replay"), 10, "every", 400),
    Topic("camera/image",            m.Image,         ("camera", "ros2", "replay"), 10, "latest"),
    Topic("external/pose",           m.ExternalPose,  ("ros2", "replay"),       10, "every", 400),
    Topic("localization/odometry", m.Odometry, ("localization",), 10, "every", 400, "up", thinned=True),
    Topic("localization/correction", m.Correction,    ("localization",),         0, "latched", 1, "up"),
    Topic("localization/anchors",    m.Anchors,       ("localization",),         0, "latched", 1, "up"),
    Topic("localization/movers",     m.MovingBeams,   ("localization",),        10, "every", 400),
    Topic("localization/grid", m.GridTile, ("localization",), 0, "every", 1024, "bulk", history=True),
    Topic("depth/estimate",          m.DepthEstimate, ("depth",),                5, "latest"),
    Topic("keyframes/candidate",     m.KeyframeCandidate, ("fusion",),          10, "every"),
    Topic("keyframes/decision",      m.KeyframeDecision, ("keyframes",),        10, "every"),
    Topic("fusion/depth",            m.FusedDepth,    ("fusion",),               5, "latest"),
    Topic("fusion/cloud",            m.Cloud,         ("fusion",),               1, "latest"),
    Topic("keyframes/frame",         m.Keyframe,      ("keyframes",),           2, "every", 60, "bulk", True),
    Topic("keyframes/ack",           m.KeyframeAck,   ("mapping",),              2, "every", 60, "down"),
    Topic("mapping/chunk",           m.MapChunk,      ("mapping",),              2, "every", 60),
    Topic("mapping/anchors",         m.MapAnchors,    ("mapping",),              0, "latched", 1),
    Topic("mapping/poses",           m.MapPoses,      ("mapping",),              0, "latched", 1),
    Topic("mapping/preview",         m.MapPreview,    ("mapping",),              2, "latest"),
    Topic("mapping/status",          m.MapStatus,     ("mapping",),              2, "every", 60),
    Topic("tick",                    m.Tick,          ("clock", "replay"),      1, "every", 60, "up"),
)  # fmt: skip

TOPICS: dict[str, Topic] = {row.name: row for row in _ROWS}
ROW_NUMBER: dict[str, int] = {row.name: i for i, row in enumerate(_ROWS)}

# Not in the table: each node publishes its own health under health/<node>.
HEALTH = "health"


def topic(name: str) -> Topic:
    """Return the table row of the topic `name`.

    Raises:
        KeyError: there is no such topic; the text lists all topics.
    """
    if name not in TOPICS:
        raise KeyError(f"there is no topic {name!r}; the topics are {', '.join(TOPICS)}")
    return TOPICS[name]
