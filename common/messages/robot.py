"""Messages between services, except those of the map (map.py): immutable, typed, validated at both ends.

Versions: each class has `version = "major.minor"`. Within a major version fields are only added, each with a
default value, so that all old recordings can be read (tests/common/messages/golden has a file of every
released version).
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from beamsplat.common.mapfiles.grid_tiles import MAX_TILE_CELLS
from beamsplat.common.messages.map import (
    Keyframe,
    KeyframeAck,
    KeyframeCandidate,
    KeyframeDecision,
    MapAnchors,
    MapChunk,
    MapPoses,
    MapPreview,
    MapRender,
    MapState,
    MapStatus,
)
from beamsplat.common.messages.schema import (
    Array,
    Count,
    Finite,
    Message,
    MessagePart,
    Name,
    NonNegative,
    Positive,
    StampNs,
    Text,
    Transform,
    Transforms,
    Velocity,
)  # fmt: skip
from beamsplat.common.messages.sensor_models import MAX_PIXELS, CameraModel, LidarModel
from beamsplat.common.status import TrackingStatus

MAX_BEAMS = 65536  # of a scan: eight times those of the finest planar lidars

# --- sensors -----------------------------------------------------------------------------------


class Rig(Message):
    """Calibration of the robot's camera and lidar."""

    camera: CameraModel | None = None
    lidar: LidarModel | None = None
    assumed: Annotated[tuple[Text, ...], Field(max_length=64)] = ()  # one sentence per assumed value
    source: Text = ""  # file or topic that the calibration comes from


class Image(Message):
    """One camera image with the bytes of the sensor: compressed images are transmitted as they are."""

    width_px: Annotated[int, Field(gt=0, le=16384)]
    height_px: Annotated[int, Field(gt=0, le=16384)]
    encoding: Literal["jpeg", "png", "rgb8", "bgr8", "rgba8", "bgra8", "mono8", "yuv422_yuy2"]
    step_bytes: Count = 0  # row length of a raw encoding; 0 for compressed images
    data: Annotated[np.ndarray, Array("uint8", "B")]

    @model_validator(mode="after")
    def _size_is_bounded(self) -> Image:
        if self.width_px * self.height_px > MAX_PIXELS:
            raise ValueError(f"{self.width_px}x{self.height_px}: more than {MAX_PIXELS} pixels")
        return self


class Scan(Message):
    """One revolution of a planar lidar; `stamp_ns` is the time of the first beam.

    Beam i has the direction angle_min_rad + i * angle_increment_rad in the lidar frame and was measured
    i * time_increment_s after the stamp. A beam without return is +inf. Invalid values of the sensor (NaN,
    negative) are transmitted unchanged; subscribers must handle them.
    """

    angle_min_rad: Annotated[float, Field(ge=-100.0, le=100.0)]
    angle_increment_rad: Annotated[float, Field(ge=-7.0, le=7.0)]
    time_increment_s: Annotated[float, Field(ge=0.0, le=1.0)]
    scan_time_s: Annotated[float, Field(ge=0.0, le=1000.0)]
    range_min_m: Annotated[float, Field(ge=0.0, le=1e5)]
    range_max_m: Annotated[float, Field(gt=0.0, le=1e5)]
    ranges_m: Annotated[np.ndarray, Array("float32", "N")]
    intensities: Annotated[np.ndarray, Array("float32", "M")] = Field(
        default_factory=lambda: np.zeros(0, np.float32)
    )

    @model_validator(mode="after")
    def _intensities_match_beams(self) -> Scan:
        if len(self.ranges_m) > MAX_BEAMS:
            raise ValueError(f"{len(self.ranges_m)} beams are more than {MAX_BEAMS}")
        if len(self.intensities) not in (0, len(self.ranges_m)):
            raise ValueError(f"{len(self.intensities)} intensities for {len(self.ranges_m)} beams")
        return self


class WheelOdometry(Message):
    """Pose from wheel encoders in the wheels' own drifting odom frame, and the velocity in the body frame."""

    T_odom_body: Transform
    velocity_m_s: Velocity
    angular_velocity_rad_s: Velocity


class ExternalPose(Message):
    """Pose `T_map_body` from an external source: motion capture, another SLAM system, ground truth."""

    T_map_body: Transform


# --- localization ------------------------------------------------------------------------------


class Odometry(Message):
    """Smooth pose `T_odom_body` at the stamp, with the covariance of (x, y, yaw) in m and rad.

    The lidar SLAM states the covariance of the motion over the last second, as the pose drifts without bound.

    If `metric` is False the scale of the translation is unknown: monocular odometry without a metric
    reference.

    `quality` is the probability that the errors of the motion over the last second are below 2 cm and 0.5
    degrees (None: not stated), and `quality_reason` says what limits it.
    """

    version = "1.2"

    T_odom_body: Transform
    covariance: Annotated[np.ndarray, Array("float64", 3, 3)]
    status: TrackingStatus = "ok"
    detail: Text = ""
    metric: bool = True  # since 1.1
    quality: Annotated[float, Field(ge=0.0, le=1.0)] | None = None  # since 1.2
    quality_reason: Text = ""  # since 1.2


class Correction(Message):
    """Global correction `T_map_odom` of the smooth pose: T_map_body = T_map_odom @ T_odom_body.

    It jumps at a loop closure.
    """

    T_map_odom: Transform
    optimisation: Count = 0


class Anchors(Message):
    """Poses `T_map_anchor` of all anchors (lidar submaps) after a pose-graph optimisation."""

    version = "1.1"

    anchor_ids: Annotated[np.ndarray, Array("int64", "N")]
    T_map_anchor: Transforms
    optimisation: Count = 0
    map_uuid: Text = ""  # since 1.1: UUID of the map that they belong to; "" = the source has none


class MovingBeams(Message):
    """Dynamic-beam mask of the scan with this stamp: beams that hit dynamic objects (people, carts, doors),
    because they end in space that the map knows to be free."""

    moving: Annotated[np.ndarray, Array("bool", "N")]


class Grid(Message):
    """Occupancy grid in the map frame in one piece, as in old recordings; now `GridTile`s are sent.

    The corner of cell [row, column] with the smallest x and y is at
    origin_m + (column, row) * resolution_m.

    Values are those of ROS: -1 unknown, 0 free .. 100 occupied. `changed` is the region that differs from the
    previous grid: row0, column0, row1, column1 (half open).
    """

    resolution_m: Positive
    origin_m: Annotated[np.ndarray, Array("float64", 2, finite=True)]
    occupancy: Annotated[np.ndarray, Array("int8", "H", "W")]
    changed: tuple[Count, Count, Count, Count] = (0, 0, 0, 0)


class GridTile(Message):
    """One square tile of the occupancy grid in the map frame (common/mapfiles/grid_tiles.py).

    A producer sends the tiles that have changed. A subscriber that joins late receives the others from the
    publisher's cache: a tile is sent again before it leaves the cache. Tiles of another `map_uuid` or
    `since_ns` replace all.
    """

    resolution_m: Positive
    size: Annotated[int, Field(ge=1, le=MAX_TILE_CELLS)]  # edge in cells
    row: Annotated[int, Field(ge=-(2**20), lt=2**20)]  # the tile begins at y = row * size * resolution_m
    column: Annotated[int, Field(ge=-(2**20), lt=2**20)]  # and at x = column * size * resolution_m
    # int8 [size, size], row 0 at the smallest y; -1 unknown, 0 free .. 100 occupied, compressed by zlib.
    # Empty: all cells are unknown.
    packed: Annotated[np.ndarray, Array("uint8", "B")]
    remaining: Count = 0  # tiles that follow in the same update; 0 = the grid is consistent now
    map_uuid: Text = ""
    since_ns: StampNs = 0  # stamp of the first tile that this process has sent


# --- depth and fusion --------------------------------------------------------------------------


class DepthEstimate(Message):
    """Output of a depth source for the undistorted image with this stamp; `kind` defines the values:

    metric: optical z in metres; relative: optical z up to a factor; disparity: a / z + b with unknown a and
    b; none: no values (0 x 0). If the status is not "ok" the values must not be used.
    """

    source: Name
    kind: Literal["metric", "relative", "disparity", "none"]
    values: Annotated[np.ndarray, Array("float32", "H", "W")]  # NaN = unknown
    status: Text = "ok"


class FusedDepth(Message):
    """Metric depth of the undistorted image with this stamp, its standard deviation, and metrics of the fit.

    Depth and standard deviation are encoded by `depth_codec`, as in keyframes. If the status is not "ok"
    there is no depth (both are empty): a depth map with a bad fit is rejected.
    """

    version = "2.0"  # 1.0: float32 arrays depth_m and sigma_m
    oldest_major = 1

    depth: Annotated[np.ndarray, Array("uint8", "D")]  # optical z
    sigma: Annotated[np.ndarray, Array("uint8", "S")]  # standard deviation, with gross errors
    status: Text = "ok"  # or why there is no depth
    keyframe: bool = False  # whether the image is a keyframe
    scale: float = float("nan")  # metres per unit of the estimate (the paper's alpha)
    scale_sigma: float = float("nan")  # standard deviation of the scale, as that of the whole image
    inlier_share: NonNegative = 0.0  # fraction of the pairs that support the fit
    residual_m: float = float("nan")  # of the inliers
    pairs: Count = 0  # pairs of a beam and a depth pixel
    beams_age_ns: Annotated[int, Field(ge=-(2**63), lt=2**63)] = 0  # image stamp minus stamp of the beams
    T_odom_body: Transform = Field(default_factory=lambda: np.eye(4))

    @classmethod
    def of(cls, depth_m: np.ndarray, sigma_m: np.ndarray, **fields: Any) -> FusedDepth:
        """Return a message with depth and standard deviation float32 [H, W] (m, NaN = unknown).

        Both are quantised, see `depth_codec`: depth to 1 mm, the standard deviation to 4.4 %.

        Raises:
            ValueError: the shapes differ, or a field is invalid.
        """
        from beamsplat.common.messages.depth_codec import pack_depth, pack_sigma  # imports OpenCV

        if depth_m.shape != sigma_m.shape:
            raise ValueError(f"depth is {list(depth_m.shape)}, sigma {list(sigma_m.shape)}")
        none = np.zeros(0, np.uint8)
        packed = (pack_depth(depth_m), pack_sigma(sigma_m)) if depth_m.size else (none, none)
        return cls(depth=packed[0], sigma=packed[1], **fields)

    @property
    def depth_m(self) -> np.ndarray:
        """Depth float32 [H, W] (optical z, m; NaN = unknown), decoded at each access; [0, 0] without depth.

        Raises:
            ValueError: the bytes are damaged.
        """
        from beamsplat.common.messages.depth_codec import unpack_depth

        return unpack_depth(self.depth) if self.depth.size else np.zeros((0, 0), np.float32)

    @property
    def sigma_m(self) -> np.ndarray:
        """Standard deviation float32 [H, W] (m; NaN = unknown), decoded at each access; as `depth_m`."""
        from beamsplat.common.messages.depth_codec import unpack_sigma

        return unpack_sigma(self.sigma) if self.sigma.size else np.zeros((0, 0), np.float32)

    @classmethod
    def upgraded(cls, major: int, fields: dict[str, Any]) -> dict[str, Any]:
        """Quantise the arrays of version 1."""
        floats = Array("float32", "H", "W")
        depth_m, sigma_m = (floats.check(fields.pop(name, None)) for name in ("depth_m", "sigma_m"))
        quantised = cls.of(depth_m, sigma_m, stamp_ns=0)
        return {**fields, "depth": quantised.depth, "sigma": quantised.sigma}


class Cloud(Message):
    """Coloured point cloud of one image in the odom frame."""

    points_odom_m: Annotated[np.ndarray, Array("float32", "N", 3, finite=True)]
    colours: Annotated[np.ndarray, Array("uint8", "N", 3)]


# --- system ------------------------------------------------------------------------------------


class Tick(Message):
    """A timer event. Timer events are messages, so that a replay repeats them."""

    count: Count


class InputHealth(MessagePart):
    """Message counts of one subscription of a node since the node's process started."""

    topic: Name
    received: Count  # messages passed to the node's handler
    dropped: Count  # replaced by a newer message (`latest`) or removed from a full queue: expected under load
    lost: Count  # gaps in the sequence of an `every` topic that were not recovered within 5 s: a fault
    undecodable: Count
    stale: Count  # repeated, or of an earlier process of the publisher
    age_ms: NonNegative  # publication to handler, newest message; 0 = unknown (publisher on another host)
    late: Count = 0  # recovered after newer messages; since Health 1.2
    refused: Count = 0  # of a process without proof that it succeeds the known publisher; since Health 1.2


class OutputHealth(MessagePart):
    """Counts of messages and bytes on one published topic of a node since the node's process started."""

    topic: Name
    sent: Count
    bytes: Count
    refused: Count = 0  # not sent, because larger than the topic's limit; since Health 1.2


class Rejected(MessagePart):
    """Number of inputs or results that a node has refused for one reason."""

    topic: Name  # of the missing result; "" = an input
    reason: Name
    count: Count


class NodeFigure(MessagePart):
    """One number that a node reports; `beamsplat.common.runtime.figures` lists the names and units."""

    name: Name
    value: Finite


# "failed": the node's process cannot run, and its supervisor reports it.
NodeState = Literal["configure", "standby", "active", "drain", "drained", "closed", "failed"]


class Health(Message):
    """State, message counts and resource use of one node, published by each node at 1 Hz.

    New fields follow all others, here and in the classes of its entries: `health_codec` needs their order.
    """

    # 1.1: pid; 1.2: state "failed", counters `late` and `refused`; 1.3: rejected; 1.4: status, figures,
    # clock_id
    version = "1.4"

    node: Name
    instance: Name
    epoch: Count
    state: NodeState
    inputs: Annotated[tuple[InputHealth, ...], Field(max_length=64)] = ()
    outputs: Annotated[tuple[OutputHealth, ...], Field(max_length=64)] = ()
    step_p50_ms: NonNegative = 0.0
    step_p95_ms: NonNegative = 0.0
    rss_mb: NonNegative = 0.0
    cpu_percent: NonNegative = 0.0
    detail: Text = ""
    pid: Count = 0  # process id on its host; 0 = not reported
    rejected: Annotated[tuple[Rejected, ...], Field(max_length=64)] = ()
    # Of the newest result with a status: "ok", or why it is missing; "" = none yet.
    status: Text = ""
    figures: Annotated[tuple[NodeFigure, ...], Field(max_length=64)] = ()
    # Of the host's monotonic clock (`header.local_clock_id`): equal for all nodes of one host; 0 = unknown.
    clock_id: Annotated[int, Field(ge=0, lt=2**64)] = 0


class HealthBundle(Message):
    """The newest health reports of the nodes of one side of a link, for the other side (`health_codec`)."""

    packed: Annotated[np.ndarray, Array("uint8", "B")]


class Answer(Message):
    """Result of a command as one sentence."""

    text: Text


MESSAGES: dict[str, type[Message]] = {
    cls.schema_name(): cls
    for cls in (
        Rig, Image, Scan, WheelOdometry, ExternalPose, Odometry, Correction, Anchors, MovingBeams, Grid,
        GridTile, DepthEstimate, FusedDepth, Cloud, KeyframeCandidate, KeyframeDecision, Keyframe,
        KeyframeAck, MapChunk, MapAnchors, MapPoses, MapPreview, MapRender, MapState, MapStatus, Tick,
        Health, HealthBundle, Answer,
    )
}  # fmt: skip
