"""What the mapping service hears and says, as the values that its libraries take and give."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import cv2
import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.camera import Pinhole, Undistorter
from beamsplat.common.mapfiles.session import Arrays, packed_arrays, unpacked_arrays
from beamsplat.common.messages import Keyframe, KeyframeAck, MapChunk, MapPreview, MapState
from beamsplat.common.messages.codec import encode, schema_of
from beamsplat.common.messages.depth_png import depth_from_png, mask_from_png, sigma_from_png
from beamsplat.common.messages.image_codec import decode_rgb
from beamsplat.common.messages.splat_codec import pack
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.services.mapping.chunks import Eye, Part
from beamsplat.services.mapping.keyframe import Keyframe as MapKeyframe
from beamsplat.services.mapping.preview import Look

_PIECE_BYTES = 4 << 20


def ack(message: Keyframe, status: str) -> tuple[str, KeyframeAck]:
    """The answer to a keyframe, as a node sends it."""
    return "keyframes/ack", KeyframeAck(stamp_ns=message.stamp_ns, id=message.id, status=status)


def body_of(message: Keyframe) -> tuple[str, bytes]:
    """A keyframe as a session keeps it: schema and payload."""
    return schema_of(message), encode(message)


def open_keyframe(message: Keyframe, lens: Callable[[Pinhole], Undistorter]) -> MapKeyframe:
    """Decoded and undistorted: everything behind sees a pinhole.

    Raises:
        UserError, ValueError: picture, depth, sigma or mask do not decode, or are of another size.
    """
    camera = message.camera
    undistort = lens(
        Pinhole.of(camera)
    )  # fmt: skip
    p = undistort.pinhole
    rgb = decode_rgb(message.picture, message.encoding, p.width_px, p.height_px)
    mask = mask_from_png(message.mask_png) if len(message.mask_png) else None
    return MapKeyframe(
        id=message.id, rgb=undistort(rgb),
        camera=RasterCamera(p.fx_px, p.fy_px, p.cx_px, p.cy_px, p.width_px, p.height_px),
        T_anchor_camera=message.T_anchor_body @ camera.T_body_camera,
        depth_m=depth_from_png(message.depth_png), sigma_m=sigma_from_png(message.sigma_png),
        anchor=message.anchor_id, beams_uvz=message.beams[:, :3].astype(np.float64), mask=mask,
    )  # fmt: skip


def preview_message(keyframe: Keyframe, view: Look) -> MapPreview:
    """The map from that keyframe, as a JPEG."""
    bgr = cv2.cvtColor(view.rgb, cv2.COLOR_RGB2BGR)
    render = cv2.imencode(".jpg", bgr, (cv2.IMWRITE_JPEG_QUALITY, 85))[1].ravel()
    return MapPreview(
        stamp_ns=keyframe.stamp_ns, keyframe_id=keyframe.id, render=render, T_map_camera=view.T_map_camera
    )  # fmt: skip


def chunk_message(T_map_anchor: np.ndarray, anchor: int, part: Part, stamp_ns: int) -> MapChunk:
    """A chunk, packed."""
    return MapChunk(
        stamp_ns=stamp_ns, anchor_id=anchor, revision=part.version, cell_m=part.cell_m,
        T_map_anchor=T_map_anchor, count=part.params.shape[1], packed=pack(part.params),
    )  # fmt: skip


def state_messages(arrays: Arrays) -> Iterator[MapState]:
    """A state in pieces that a link carries."""
    blob = packed_arrays(arrays)
    for first in range(0, len(blob), _PIECE_BYTES):
        piece = np.frombuffer(blob[first : first + _PIECE_BYTES], np.uint8)
        yield MapState(stamp_ns=0, first=first, total=len(blob), data=piece)


def joined_state(pieces: list[MapState]) -> Arrays:
    """The state that came in pieces, in any order.

    Raises:
        UserError: some of it did not come.
    """
    pieces = sorted(pieces, key=lambda piece: piece.first)
    blob = b"".join(piece.data.tobytes() for piece in pieces)
    if not pieces or len(blob) != pieces[0].total:
        raise UserError(f"{len(blob)} of {pieces[0].total if pieces else 0} bytes of the map came: ask again")
    return unpacked_arrays(blob)


def eye_of(parameters: dict[str, str]) -> Eye | None:
    """The eye that a query names, if it names one.

    Raises:
        UserError: it names half of one, or no numbers.
    """
    if "from" not in parameters:
        return None
    try:
        x, y, z = (float(word) for word in parameters["from"].split(","))
        return Eye(np.array([x, y, z]), float(parameters["focal_px"]), float(parameters.get("error_px", "1")))
    except (KeyError, ValueError) as error:
        raise UserError("snapshot: expected from=X,Y,Z and focal_px=F, numbers") from error
