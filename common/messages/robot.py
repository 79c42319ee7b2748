"""What travels between services: frozen, typed, checked on the way in and on the way out.

Versions: a class carries `version = "major.minor"`. Within a major, fields are only ever added, and
each added field has a default, so that old recordings open for ever (tests/common/golden holds one
file of every released version).
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from beamsplat.common.messages.map import (
    Keyframe,
    KeyframeAck,
    MapChunk,
    MapPoses,
    MapPreview,
    MapState,
    MapStatus,
)
from beamsplat.common.messages.schema import (
    Array,
    Count,
    Finite,
    Message,
    Name,
    NonNegative,
    Part,
    Positive,
    Text,
    Transform,
    Transforms,
)  # fmt: skip
from beamsplat.common.messages.sensor_models import CameraModel, LidarModel

# --- sensors -----------------------------------------------------------------------------------


class Rig(Message):
    """Calibration in use: what was found, and in `assumed`, one sentence for each value that was not."""

    camera: CameraModel | None = None
    lidar: LidarModel | None = None
    assumed: Annotated[tuple[Text, ...], Field(max_length=64)] = ()
    source: Text = ""


class Image(Message):
    """One camera picture, in the bytes the sensor gave: compressed ones are never decoded on the way."""

    width_px: Annotated[int, Field(gt=0, le=16384)]
    height_px: Annotated[int, Field(gt=0, le=16384)]
    encoding: Literal["jpeg", "png", "rgb8", "bgr8", "rgba8", "bgra8", "mono8", "yuv422_yuy2"]
    step_bytes: Count = 0  # bytes of a row of a raw encoding; 0 for compressed
    data: Annotated[np.ndarray, Array("uint8", "B")]


class Scan(Message):
    """One revolution of a planar lidar, as measured; `stamp_ns` is the time of the first beam.

    Beam i points at angle_min_rad + i * angle_increment_rad in the lidar frame and was taken
    i * time_increment_s after the stamp. No return is +inf; rubbish (NaN, negative) passes unchanged,
    consumers decide.
    """

    angle_min_rad: Finite
    angle_increment_rad: Annotated[float, Field(allow_inf_nan=False)]
    time_increment_s: NonNegative
    scan_time_s: NonNegative
    range_min_m: NonNegative
    range_max_m: Positive
    ranges_m: Annotated[np.ndarray, Array("float32", "N")]
    intensities: Annotated[np.ndarray, Array("float32", "M")] = Field(
        default_factory=lambda: np.zeros(0, np.float32)
    )

    @model_validator(mode="after")
    def _intensities_are_none_or_one_a_beam(self) -> Scan:
        if len(self.intensities) not in (0, len(self.ranges_m)):
            raise ValueError(f"{len(self.intensities)} intensities for {len(self.ranges_m)} beams")
        return self


class WheelOdometry(Message):
    """Pose by wheel counting in its own drifting frame, and the body's velocity."""

    T_odom_body: Transform
    velocity_m_s: Annotated[np.ndarray, Array("float64", 3, finite=True)]
    angular_velocity_rad_s: Annotated[np.ndarray, Array("float64", 3, finite=True)]


class ExternalPose(Message):
    """`T_map_body` from somebody else's localization (motion capture, another SLAM, recorded truth)."""

    T_map_body: Transform


# --- localization ------------------------------------------------------------------------------


class Odometry(Message):
    """Smooth pose `T_odom_body` at the stamp, with the covariance of (x, y, yaw).

    Where `metric` is False its unit of length is nobody's: a camera alone, without anything of known size.
    """

    version = "1.1"

    T_odom_body: Transform
    covariance: Annotated[np.ndarray, Array("float64", 3, 3)]
    status: Literal["ok", "lost", "relocalizing", "rejected"] = "ok"
    detail: Text = ""
    metric: bool = True  # since 1.1


class Correction(Message):
    """`T_map_odom`: takes the smooth pose to the map; may jump when a loop closes."""

    T_map_odom: Transform
    optimisation: Count = 0


class Anchors(Message):
    """`T_map_anchor` of all anchors (lidar submaps) after an optimisation."""

    version = "1.1"

    anchor_ids: Annotated[np.ndarray, Array("int64", "N")]
    T_map_anchor: Transforms
    optimisation: Count = 0
    map_uuid: Text = ""  # since 1.1: of the map that they belong to; "" = its maker gives none


class MovingBeams(Message):
    """Which beams of the scan with this stamp ended in space known to be free: people, carts, doors."""

    moving: Annotated[np.ndarray, Array("bool", "N")]


class Grid(Message):
    """Occupancy grid: cell [row, column] covers origin + (column, row) * resolution, y up.

    Values as nav2: -1 unknown, 0 free .. 100 occupied. `changed` is the region touched since the grid
    before: row0, column0, row1, column1 (half open).
    """

    resolution_m: Positive
    origin_m: Annotated[np.ndarray, Array("float64", 2, finite=True)]
    occupancy: Annotated[np.ndarray, Array("int8", "H", "W")]
    changed: tuple[Count, Count, Count, Count] = (0, 0, 0, 0)


# --- depth and fusion --------------------------------------------------------------------------


class DepthEstimate(Message):
    """What a depth source says of the picture with this stamp, undistorted; what it means, `kind` says.

    metric: metres of optical z; relative: up to a factor; disparity: a / z + b; none: no values (0 x 0).
    With a status other than "ok" the values must not be used.
    """

    source: Name
    kind: Literal["metric", "relative", "disparity", "none"]
    values: Annotated[np.ndarray, Array("float32", "H", "W")]  # NaN = no answer
    status: Text = "ok"


class FusedDepth(Message):
    """Metric depth of the picture with this stamp, undistorted, with its error bar and how it came about.

    With a status other than "ok" there is no depth (0 x 0): a bad frame is refused, not used.
    """

    depth_m: Annotated[np.ndarray, Array("float32", "H", "W")]  # optical z, NaN = unknown
    sigma_m: Annotated[np.ndarray, Array("float32", "H", "W")]  # standard deviation
    status: Text = "ok"
    keyframe: bool = False
    scale: float = float("nan")  # metres per unit of the estimate (the paper's alpha)
    scale_sigma: float = float("nan")
    inlier_share: NonNegative = 0.0
    residual_m: float = float("nan")
    pairs: Count = 0
    beams_age_ns: Annotated[int, Field(ge=-(2**63), lt=2**63)] = 0  # picture minus the beams used
    T_odom_body: Transform = Field(default_factory=lambda: np.eye(4))


class Cloud(Message):
    """Coloured points of a picture in the odom frame."""

    points_odom_m: Annotated[np.ndarray, Array("float32", "N", 3, finite=True)]
    colours: Annotated[np.ndarray, Array("uint8", "N", 3)]


# --- the system itself -------------------------------------------------------------------------


class Tick(Message):
    """A timer's beat: time passes as a message, so that a replay repeats it."""

    count: Count


class InputHealth(Part):
    """One subscription of one node, since it started."""

    topic: Name
    received: Count  # handed to the node
    dropped: Count  # overtaken in the ring or overflowed: by design, but counted
    lost: Count  # gaps in the sequence of an `every` stream: a fault
    undecodable: Count
    stale: Count  # from an epoch that has been taken over
    age_ms: NonNegative  # publish to handler, of the newest, on clocks of one host; 0 if unknown


class OutputHealth(Part):
    """One publication of one node."""

    topic: Name
    sent: Count
    bytes: Count


class Health(Message):
    """Once a second from every node."""

    node: Name
    instance: Name
    epoch: Count
    state: Literal["configure", "standby", "active", "drain", "drained", "closed"]
    inputs: Annotated[tuple[InputHealth, ...], Field(max_length=64)] = ()
    outputs: Annotated[tuple[OutputHealth, ...], Field(max_length=64)] = ()
    step_p50_ms: NonNegative = 0.0
    step_p95_ms: NonNegative = 0.0
    rss_mb: NonNegative = 0.0
    cpu_percent: NonNegative = 0.0
    detail: Text = ""


class Answer(Message):
    """What was done about a request, in one sentence."""

    text: Text


MESSAGES: dict[str, type[Message]] = {
    cls.schema_name(): cls
    for cls in (
        Rig, Image, Scan, WheelOdometry, ExternalPose, Odometry, Correction, Anchors, MovingBeams, Grid,
        DepthEstimate, FusedDepth, Cloud, Keyframe, KeyframeAck, MapChunk, MapPoses, MapPreview, MapState,
        MapStatus, Tick, Health, Answer,
    )
}  # fmt: skip
