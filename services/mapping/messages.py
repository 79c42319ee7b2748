"""Conversion between the messages of the mapping service and the types of its libraries."""

from __future__ import annotations

import math
import zipfile
import zlib
from collections.abc import Callable, Iterator

import cv2
import numpy as np

from beamsplat.common.errors import UserError, reason
from beamsplat.common.geometry.camera import Pinhole, Undistorter
from beamsplat.common.geometry.depth_sigma import typical_sigma_m
from beamsplat.common.mapfiles.session import Arrays, packed_arrays, unpacked_arrays
from beamsplat.common.messages import (
    CameraModel,
    Image,
    Keyframe,
    KeyframeAck,
    MapAnchors,
    MapChunk,
    MapPoses,
    MapPreview,
    MapRender,
    MapState,
    MapStatus,
)
from beamsplat.common.messages.codec import encode, schema_of
from beamsplat.common.messages.depth_codec import unpack_depth, unpack_mask, unpack_sigma
from beamsplat.common.messages.image_codec import decode_rgb
from beamsplat.common.messages.splat_codec import pack
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.services.mapping.chunks import ChunkUpdate
from beamsplat.services.mapping.keyframe import RgbdKeyframe
from beamsplat.services.mapping.mapper import InsertionResult, Mapper
from beamsplat.services.mapping.preview import KeyframeRender, MapView

_PIECE_BYTES = 4 << 20  # of a state in one message


def ack(message: Keyframe, status: str) -> tuple[str, KeyframeAck]:
    """Return topic and message that acknowledge a keyframe; `status` is "ok" or why it was rejected."""
    return "keyframes/ack", KeyframeAck(stamp_ns=message.stamp_ns, id=message.id, status=status)


def encode_keyframe(message: Keyframe) -> tuple[str, bytes]:
    """Return (schema, payload) of a keyframe message, the format of keyframe files in a session.

    A received keyframe is stored as it was received.
    """
    return schema_of(message), encode(message)


def decode_keyframe(message: Keyframe, lens: Callable[[Pinhole], Undistorter]) -> RgbdKeyframe:
    """Decode and undistort a keyframe message: all later stages use a pinhole camera.

    Args:
        lens: returns the undistorter of a camera model, for example from a cache.

    Raises:
        UserError, ValueError: image, depth, sigma or mask cannot be decoded or have the wrong size.
    """
    camera = message.camera
    undistort = lens(
        Pinhole.of(camera)
    )  # fmt: skip
    p = undistort.pinhole
    rgb = decode_rgb(message.picture, message.encoding, p.width_px, p.height_px)
    mask = unpack_mask(message.mask, p.shape) if len(message.mask) else None
    depth_m = unpack_depth(message.depth, p.shape)
    return RgbdKeyframe(
        id=message.id, rgb=undistort(rgb),
        camera=RasterCamera(p.fx_px, p.fy_px, p.cx_px, p.cy_px, p.width_px, p.height_px),
        T_anchor_camera=message.T_anchor_body @ camera.T_body_camera,
        depth_m=depth_m, sigma_m=typical_sigma_m(depth_m, unpack_sigma(message.sigma, p.shape)),
        anchor=message.anchor_id, beams_uvz=message.beams[:, :3].astype(np.float64), mask=mask,
    )  # fmt: skip


def keyframe_rgb(message: Keyframe, lens: Callable[[Pinhole], Undistorter]) -> np.ndarray:
    """Return the undistorted image of a keyframe message, uint8 [H, W, 3]; `lens` as in `decode_keyframe`.

    Raises:
        UserError, ValueError: the image cannot be decoded or has the wrong size.
    """
    undistort = lens(Pinhole.of(message.camera))
    p = undistort.pinhole
    return undistort(decode_rgb(message.picture, message.encoding, p.width_px, p.height_px))


def image_message(rgb: np.ndarray) -> Image:
    """Return an image uint8 [H, W, 3] as a message, encoded as JPEG."""
    height, width = rgb.shape[:2]
    data = _jpeg(np.ascontiguousarray(rgb), 90)
    return Image(stamp_ns=0, width_px=width, height_px=height, encoding="jpeg", data=data)


def preview_message(keyframe: Keyframe, view: KeyframeRender) -> MapPreview:
    """Return the preview message of a keyframe: the render of the map at its pose, as JPEG."""
    return MapPreview(
        stamp_ns=keyframe.stamp_ns, keyframe_id=keyframe.id, render=_jpeg(view.rgb, 85),
        T_map_camera=view.T_map_camera, camera=_camera_model(view.camera, keyframe.camera.T_body_camera),
    )  # fmt: skip


def render_message(view: MapView, T_map_camera: np.ndarray) -> MapRender:
    """Return the map, rendered from the pose of a query, as a message.

    Raises:
        UserError: a message does not allow the camera.
    """
    camera = _camera_model(view.camera, np.eye(4))
    if camera is None:
        raise UserError("render: the camera's principal point is at the edge of the image")
    return MapRender(
        stamp_ns=0, render=_jpeg(view.rgb, 90), T_map_camera=T_map_camera, camera=camera,
        left_out=view.left_out,
    )  # fmt: skip


def _jpeg(rgb: np.ndarray, quality: int) -> np.ndarray:
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, (cv2.IMWRITE_JPEG_QUALITY, quality))[1].ravel()


def _camera_model(camera: RasterCamera, T_body_camera: np.ndarray) -> CameraModel | None:
    """Return a camera of the rasterizer as part of a message; None if a message does not allow its K."""
    try:
        return CameraModel(
            width_px=camera.width_px, height_px=camera.height_px, fx_px=camera.fx_px, fy_px=camera.fy_px,
            cx_px=camera.cx_px, cy_px=camera.cy_px, T_body_camera=T_body_camera,
        )  # fmt: skip
    except ValueError:  # a principal point within half a pixel of the edge of the image
        return None


def chunk_message(mapper: Mapper, anchor: int, update: ChunkUpdate, stamp_ns: int) -> MapChunk:
    """Return the message of the chunk of an anchor, with packed Gaussians."""
    return MapChunk(
        stamp_ns=stamp_ns, anchor_id=anchor, revision=update.version, cell_m=update.cell_m,
        T_map_anchor=mapper.T_map_anchor[anchor], pose_revision=mapper.pose_revision,
        count=update.params.shape[1], packed=pack(update.params),
    )  # fmt: skip


def anchors_message(mapper: Mapper, stamp_ns: int) -> MapAnchors:
    """Return the message of the poses of all anchors."""
    ids = sorted(mapper.T_map_anchor)
    poses = np.array([mapper.T_map_anchor[anchor] for anchor in ids]).reshape(-1, 4, 4)
    return MapAnchors(
        stamp_ns=stamp_ns, pose_revision=mapper.pose_revision, anchor_ids=np.array(ids, np.int64),
        T_map_anchor=poses,
    )  # fmt: skip


def poses_message(poses: tuple[np.ndarray, np.ndarray, np.ndarray]) -> MapPoses:
    """Return the message of what `KeyframeIntake.poses` returns, of at least one keyframe."""
    stamps_ns, T_map_body, ids = poses
    return MapPoses(stamp_ns=int(stamps_ns[-1]), keyframe_ids=ids, stamps_ns=stamps_ns, T_map_body=T_map_body)


def status_message(
    mapper: Mapper, outcome: InsertionResult, *, stamp_ns: int, keyframes: int, refused: int, loss: float,
    psnr_db: float, depth_error_m: float, session: str,
) -> MapStatus:  # fmt: skip
    """Return the state of the map after the insertion of a keyframe.

    Args:
        outcome: of the insertion.
        stamp_ns: of the keyframe.
        keyframes, refused: their numbers in all.
        loss: mean of the steps that followed.
        psnr_db: PSNR of the keyframe, NaN if not measured.
        depth_error_m: median error of its depth, m, NaN if not measured.
        session: state of the saved map in one line; "" without one.
    """
    return MapStatus(
        stamp_ns=stamp_ns, status=outcome.status, keyframes=keyframes, refused=refused,
        gaussians=mapper.store.count + mapper.store.paged_out_count,
        steps=mapper.steps, loss=loss, foretold_share=outcome.predicted_coverage,
        foretold_psnr_db=outcome.predicted_psnr_db, psnr_db=psnr_db, depth_error_m=depth_error_m,
        session=session,
    )  # fmt: skip


def status_text(status: MapStatus, backlog: int, engine: str) -> str:
    """Return a state of the map in one line.

    Args:
        backlog: keyframes that wait on the robot.
        engine: what computes the map, in words.
    """
    quality = f", {status.psnr_db:.1f} dB" if math.isfinite(status.psnr_db) else ""
    waiting = f", {backlog} wait on the robot" if backlog else ""
    text = f"{status.keyframes} keyframes{waiting}, {status.gaussians} Gaussians{quality}" + (
        f", {status.refused} refused (last: {status.status})" if status.status != "ok" else ""
    )
    return "; ".join(filter(None, (text, status.session, engine)))


def state_messages(arrays: Arrays) -> Iterator[MapState]:
    """Yield the arrays of a saved map as messages of at most 4 MiB each."""
    blob = packed_arrays(arrays)
    for first in range(0, len(blob), _PIECE_BYTES):
        piece = np.frombuffer(blob[first : first + _PIECE_BYTES], np.uint8)
        yield MapState(stamp_ns=0, first=first, total=len(blob), data=piece)


def joined_state(pieces: list[MapState]) -> Arrays:
    """Join the messages of `state_messages`, in any order, to the arrays of a saved map.

    Raises:
        UserError: some bytes are missing, or they are no arrays.
    """
    pieces = sorted(pieces, key=lambda piece: piece.first)
    blob = b"".join(piece.data.tobytes() for piece in pieces)
    if not pieces or len(blob) != pieces[0].total:
        raise UserError(
            f"received {len(blob)} of {pieces[0].total if pieces else 0} bytes of the map: try again"
        )
    try:
        return unpacked_arrays(blob)
    except (OSError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        raise UserError(f"the mapper sent a map that cannot be read ({reason(error)}): try again") from error
