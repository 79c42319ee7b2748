"""Messages between keyframes, mapper and viewers; `beamsplat.common.messages` has all of them."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from beamsplat.common.messages.schema import Array, Count, Message, NonNegative, Text, Transform, Transforms
from beamsplat.common.messages.sensor_models import CameraModel

ODOM_ORIGIN = -1  # `anchor_id` of keyframes sent before localization has published an anchor


class Keyframe(Message):
    """A picture that is to become part of the map, with all that the map needs of it: nothing else of this
    moment has to survive an outage. The same `id` always means the same content.

    T_map_body = T_map_anchor @ T_anchor_body; both of this `optimisation`. A later one moves the anchor only.
    Depth and mask belong to the undistorted picture (a pinhole with the camera's K). Depths are PNGs of
    uint16 millimetres, 0 = unknown (`depth_png`); the mask is a PNG, 0 = on something that moves.
    """

    version = "1.2"

    id: Count
    encoding: Literal["jpeg", "png"]
    picture: Annotated[np.ndarray, Array("uint8", "P")]
    camera: CameraModel
    anchor_id: Annotated[int, Field(ge=-1, lt=2**63)]  # a lidar submap; -1 = the odom frame's origin
    T_anchor_body: Transform
    T_map_anchor: Transform
    optimisation: Count = 0
    depth_png: Annotated[np.ndarray, Array("uint8", "D")]  # optical z
    sigma_png: Annotated[np.ndarray, Array("uint8", "S")]  # standard deviation
    mask_png: Annotated[np.ndarray, Array("uint8", "M")] = Field(
        default_factory=lambda: np.zeros(0, np.uint8)
    )
    # Returns of the moment, brought to the picture's time: u, v (px, undistorted), z, sigma (m).
    beams: Annotated[np.ndarray, Array("float32", "N", 4, finite=True)] = Field(
        default_factory=lambda: np.zeros((0, 4), np.float32)
    )
    why: Text = ""  # it was chosen
    backlog: Count = 0  # keyframes not acknowledged when this one went out; since 1.1
    map_uuid: Text = ""  # of the map that the anchor belongs to (`Anchors`); since 1.2


class KeyframeAck(Message):
    """The mapper has a keyframe, which need not be sent again: "ok", or why it was refused. One that was "ok"
    when it came can be refused later, when it is looked at."""

    id: Count
    status: Text = "ok"


class MapChunk(Message):
    """The Gaussians bound to one anchor, in the anchor's frame, packed by `splat_codec`. A newer `revision`
    replaces all of the older one, as does the same one in finer cells; `count` 0 takes it away."""

    version = "1.1"

    anchor_id: Annotated[int, Field(ge=-1, lt=2**63)]
    revision: Count
    T_map_anchor: Transform
    count: Count
    packed: Annotated[np.ndarray, Array("uint8", "B")]
    cell_m: NonNegative = 0.0  # Gaussians within such a cell are merged into one; 0 = none are; since 1.1


class MapState(Message):
    """A piece of a mapper's whole state, as its checkpoint holds it (an .npz), for who asks."""

    first: Count  # byte of the state with which `data` begins
    total: Count  # bytes of the state
    data: Annotated[np.ndarray, Array("uint8", "B")]


class MapPoses(Message):
    """Where the map's keyframes are, refined: T_map_body = T_map_anchor @ T_anchor_body @ (what the mapper
    found, brought to the body)."""

    keyframe_ids: Annotated[np.ndarray, Array("int64", "N")]
    stamps_ns: Annotated[np.ndarray, Array("int64", "N")]
    T_map_body: Transforms


class MapPreview(Message):
    """The map as seen from its newest keyframe, as a JPEG of the picture's own shape."""

    keyframe_id: Count
    render: Annotated[np.ndarray, Array("uint8", "B")]
    T_map_camera: Transform


class MapStatus(Message):
    """How the map is doing after a keyframe. Errors are of the newest keyframe's own view: of what the map
    foretold before it took the picture in, where it knew anything there, and after."""

    version = "1.1"

    status: Text = "ok"  # or why the newest keyframe was refused
    keyframes: Count = 0
    refused: Count = 0
    gaussians: Count = 0
    steps: Count = 0
    loss: NonNegative = 0.0
    foretold_share: NonNegative = 0.0  # of the pixels, that the map covered before
    foretold_psnr_db: float = float("nan")
    psnr_db: float = float("nan")
    depth_error_m: float = float("nan")  # median |rendered - fused|
    session: Text = ""  # since 1.1: how far the map is on disk, or "NOT SAVED: " and why; "" = not asked for
