"""Messages between keyframe selection, mapper and viewers. Import them from `beamsplat.common.messages`."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from beamsplat.common.messages.schema import Array, Count, Message, NonNegative, Text, Transform, Transforms
from beamsplat.common.messages.sensor_models import CameraModel

ODOM_ORIGIN = -1  # `anchor_id` of keyframes sent before localization has published an anchor


class KeyframeCandidate(Message):
    """Request of fusion for a decision: must the image with this stamp become a keyframe?

    Fusion can compute depth for this image.
    """

    T_odom_body: Transform
    sharpness: NonNegative  # of the undistorted image, `geometry.keyframe_selection.sharpness`


class KeyframeDecision(Message):
    """The answer to the candidate with the same stamp."""

    keyframe: bool
    reason: Text = ""


class Keyframe(Message):
    """An image to be added to the map, with all data that the mapper needs: it is self-contained, so that no
    other message of this time must be stored during a network outage. An `id` always has the same content.

    T_map_body = T_map_anchor @ T_anchor_body; both are results of pose-graph optimisation number
    `optimisation`. A later optimisation changes T_map_anchor only. Depth, standard deviation and mask refer
    to the undistorted image (a pinhole with the camera's K) and are encoded by `depth_codec`, or are PNGs of
    an earlier version; mask 0 = on a dynamic object.

    How many keyframes the robot has sent without an acknowledgement is in the message's header: the same
    payload is stored and sent again.
    """

    version = "2.0"  # 1.x: depth_png, sigma_png and mask_png, PNGs; backlog
    oldest_major = 1

    id: Count
    encoding: Literal["jpeg", "png"]
    picture: Annotated[np.ndarray, Array("uint8", "P")]
    camera: CameraModel
    anchor_id: Annotated[int, Field(ge=-1, lt=2**63)]  # id of a lidar submap; -1 = origin of the odom frame
    T_anchor_body: Transform
    T_map_anchor: Transform
    optimisation: Count = 0
    depth: Annotated[np.ndarray, Array("uint8", "D")]  # optical z
    sigma: Annotated[np.ndarray, Array("uint8", "S")]  # standard deviation of the depth
    mask: Annotated[np.ndarray, Array("uint8", "M")] = Field(
        default_factory=lambda: np.zeros(0, np.uint8)
    )  # empty = no dynamic object
    # Lidar returns deskewed to the image's time and projected: u, v (px, undistorted), optical z, sigma (m).
    beams: Annotated[np.ndarray, Array("float32", "N", 4, finite=True)] = Field(
        default_factory=lambda: np.zeros((0, 4), np.float32)
    )
    why: Text = ""  # why this image was selected as a keyframe
    map_uuid: Text = ""  # UUID of the map that the anchor belongs to (see `Anchors`); since 1.2

    @classmethod
    def upgraded(cls, major: int, fields: dict[str, Any]) -> dict[str, Any]:
        """Rename the fields of version 1; the bytes of the PNGs stay as they are."""
        renamed = {name.removesuffix("_png"): value for name, value in fields.items()}
        renamed.pop("backlog", None)
        return renamed


class KeyframeAck(Message):
    """Acknowledgement that the mapper received a keyframe; it need not be sent again.

    `status` is "ok", or why the keyframe was rejected. The mapper can reject a keyframe that it acknowledged
    with "ok" before, when it processes it.
    """

    id: Count
    status: Text = "ok"


class MapChunk(Message):
    """The Gaussians of one anchor, in the anchor's frame, encoded by `splat_codec`.

    A chunk with a higher `revision`, or with the same `revision` and smaller `cell_m`, replaces the previous
    chunk of this anchor; `count` 0 removes it. A chunk is not sent again when only its anchor has moved
    (`MapAnchors`): `T_map_anchor` is the pose when it was sent.
    """

    version = "1.2"

    anchor_id: Annotated[int, Field(ge=-1, lt=2**63)]
    revision: Count
    T_map_anchor: Transform
    count: Count
    packed: Annotated[np.ndarray, Array("uint8", "B")]
    cell_m: NonNegative = 0.0  # level of detail: Gaussians within a cell are merged; 0 = all; since 1.1
    pose_revision: Count = 0  # of T_map_anchor, see `MapAnchors`; since 1.2


class MapAnchors(Message):
    """Poses of all anchors of the map, sent when one of them has moved: a loop closure sends only this.

    `pose_revision` counts the moves of one process of the mapper, also in its chunks. Of the poses of an
    anchor in messages of both kinds, the one with the highest `pose_revision` is valid, whatever arrives
    first (`common/mapfiles/anchor_poses.py`).
    """

    pose_revision: Count
    anchor_ids: Annotated[np.ndarray, Array("int64", "N")]
    T_map_anchor: Transforms


class MapState(Message):
    """A part of a mapper's complete state in the checkpoint format (.npz), sent as answer to a query."""

    first: Count  # offset of `data` in the state, bytes
    total: Count  # size of the state, bytes
    data: Annotated[np.ndarray, Array("uint8", "B")]


class MapPoses(Message):
    """Refined poses of the map's keyframes: T_map_body = T_map_anchor @ T_anchor_body @ delta, where delta is
    the mapper's pose correction, transformed from the camera to the body frame."""

    keyframe_ids: Annotated[np.ndarray, Array("int64", "N")]
    stamps_ns: Annotated[np.ndarray, Array("int64", "N")]
    T_map_body: Transforms


class MapPreview(Message):
    """The map rendered from its newest keyframe, as a JPEG with the aspect ratio of the image."""

    version = "1.1"

    keyframe_id: Count
    render: Annotated[np.ndarray, Array("uint8", "B")]
    T_map_camera: Transform
    camera: CameraModel | None = None  # of the render: a pinhole of its size; since 1.1


class MapRender(Message):
    """The map rendered from the pose in a query, as a JPEG of the size of `camera`."""

    render: Annotated[np.ndarray, Array("uint8", "B")]
    T_map_camera: Transform
    camera: CameraModel  # a pinhole
    left_out: Count = 0  # Gaussians that may be in view but are not drawn


class MapStatus(Message):
    """State of the map after a keyframe, with rendering errors at the newest keyframe's view.

    The `foretold_` values are predictions: they compare the keyframe's image with the map before the keyframe
    was added, where the map already covered the view.
    """

    version = "1.1"

    status: Text = "ok"  # or why the newest keyframe was rejected
    keyframes: Count = 0
    refused: Count = 0  # rejected keyframes
    gaussians: Count = 0
    steps: Count = 0  # optimisation steps so far
    loss: NonNegative = 0.0
    foretold_share: NonNegative = 0.0  # fraction of the pixels that the map covered before this keyframe
    foretold_psnr_db: float = float("nan")  # PSNR over these pixels, before this keyframe
    psnr_db: float = float("nan")  # PSNR after the keyframe was added
    depth_error_m: float = float("nan")  # median |rendered - fused depth|
    session: Text = ""  # since 1.1: saving progress, or "NOT SAVED: " and the reason; "" = no session
