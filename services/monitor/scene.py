"""Drawing of the robot and its 2D map in rerun.

Entities:
    map                        the map frame, z up
    map/anchors                lidar submaps
    map/scan                   the newest scan, deskewed
    map/path/<source>          the robot's path by each source of poses
    map/odom                   the odom frame (T_map_odom); a loop closure moves it
    map/odom/body              the robot
    map/odom/body/camera       pinhole, with the image in camera/image
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
import rerun as rr

from beamsplat.common.geometry.tracks import BoundedPath, PoseBuffer, RateLimit, scan_points, sweep_to_world
from beamsplat.common.geometry.transforms import inverse, quat_xyzw_from_matrix, transform_points
from beamsplat.services.monitor.rerun_writer import RerunWriter

WORLD = "map"
BODY = f"{WORLD}/odom/body"
CAMERA = f"{BODY}/camera"
SCAN = f"{WORLD}/scan"
_SMOOTH = f"{WORLD}/odom/path"

# Sources of the robot's pose, best first; the best available one is drawn.
SOURCES = ("localization", "external", "wheel")
_COLOURS = {"localization": (80, 200, 255), "external": (120, 230, 120), "wheel": (150, 150, 150)}
_SMOOTH_COLOUR = (40, 90, 130)
_LIFT_M = {"localization": 0.03, "external": 0.02, "wheel": 0.01}  # the better one is drawn on top
_ROBOT = (255, 160, 40)
_SCAN = (255, 70, 90)
_ANCHOR = (200, 140, 255)
_FRUSTUM_M = 0.5
_WAITING_SWEEPS = 3  # a scan that waits longer for a pose is drawn with the last known one
_LOOP_RESTART_NS = 5_000_000_000  # a larger step back in time: a looping recording has restarted
_RAW_FORMATS = {
    "rgb8": (rr.ColorModel.RGB, 3),
    "bgr8": (rr.ColorModel.BGR, 3),
    "rgba8": (rr.ColorModel.RGBA, 4),
    "bgra8": (rr.ColorModel.BGRA, 4),
    "mono8": (rr.ColorModel.L, 1),
}


@dataclass(frozen=True)
class SceneStyle:
    """Sizes and limits of the drawn entities."""

    path_points: int = 2000
    path_step_m: float = 0.05
    body_size_m: tuple[float, float, float] = (0.4, 0.3, 0.25)


@dataclass
class _Sweep:
    """A scan that waits for the robot's pose at the end of the scan."""

    stamp_ns: int
    end_ns: int
    points_body: np.ndarray  # float64 [M, 3]
    share: np.ndarray  # float64 [M], time within the sweep, 0 .. 1


class Scene:
    """Stores poses and paths of the robot, and draws robot, sensors and grid."""

    def __init__(self, writer: RerunWriter, limits: RateLimit, style: SceneStyle) -> None:
        self._writer = writer
        self._limits = limits
        self._poses = {name: PoseBuffer() for name in SOURCES}
        paths = (*(f"{WORLD}/path/{name}" for name in SOURCES), _SMOOTH)
        self._paths = {entity: BoundedPath(style.path_points, style.path_step_m) for entity in paths}
        self._T_map_odom = np.eye(4)
        self._T_map_wheel: np.ndarray | None = None
        self._T_body_lidar = np.eye(4)
        self._sweeps: deque[_Sweep] = deque()
        self.newest_ns: int | None = None  # newest measurement time
        writer.log(WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        half = np.array(style.body_size_m) / 2.0
        writer.log(
            f"{BODY}/shape",
            rr.Boxes3D(half_sizes=half, centers=[0.0, 0.0, half[2]], colors=_ROBOT),
            static=True,
        )
        heading = rr.Arrows3D(origins=[half[0], 0.0, half[2]], vectors=[0.25, 0.0, 0.0], colors=_ROBOT)
        writer.log(f"{BODY}/heading", heading, static=True)

    # --- calibration ---

    def camera(
        self,
        K: np.ndarray,  # float64 [3, 3]
        size_px: tuple[int, int],  # width, height
        T_body_camera: np.ndarray,
    ) -> None:
        """Draw the camera's mount [4, 4] and field of view from K [3, 3] and the size (width, height)."""
        self._writer.log(
            CAMERA,
            _transform(T_body_camera),
            rr.Pinhole(
                image_from_camera=K, width=size_px[0], height=size_px[1],
                camera_xyz=rr.ViewCoordinates.RDF, image_plane_distance=_FRUSTUM_M,
            ),
            static=True,
        )  # fmt: skip

    def lidar(self, T_body_lidar: np.ndarray) -> None:
        """Set the lidar's mount `T_body_lidar` [4, 4]."""
        self._T_body_lidar = T_body_lidar

    # --- measurements ---

    def image(
        self,
        stamp_ns: int,
        data: np.ndarray,  # uint8 [B]
        encoding: str,  # jpeg, png, yuv422_yuy2, or one of `_RAW_FORMATS`
        size_px: tuple[int, int],  # width, height
        step_bytes: int,  # of a raw row; 0 = no padding
    ) -> None:
        """Draw a camera image; compressed images are passed to rerun without decoding."""
        self._update_newest(stamp_ns)
        if not self._limits.due("image", stamp_ns):
            return
        width, height = size_px
        drawing: rr.EncodedImage | rr.Image
        if encoding in ("jpeg", "png"):
            drawing = rr.EncodedImage(contents=data.tobytes(), media_type=f"image/{encoding}")
        elif encoding == "yuv422_yuy2":
            rows = _rows(data, height, width * 2, step_bytes)
            drawing = rr.Image(
                bytes=rows.tobytes(), width=width, height=height, pixel_format=rr.PixelFormat.YUY2
            )
        else:
            model, sinks = _RAW_FORMATS[encoding]
            rows = _rows(data, height, width * sinks, step_bytes)
            drawing = rr.Image(
                bytes=rows.tobytes(), width=width, height=height, color_model=model,
                datatype=rr.ChannelDatatype.U8,
            )  # fmt: skip
        self._writer.log(f"{CAMERA}/image", drawing, stamp_ns=stamp_ns)

    def scan(
        self,
        stamp_ns: int,
        ranges_m: np.ndarray,  # float32 [N]
        angle_min_rad: float,
        angle_increment_rad: float,
        time_increment_s: float,
        range_limits_m: tuple[float, float],
    ) -> None:
        """Draw a scan in the map frame, as soon as the robot's pose at the end of the scan is known."""
        self._update_newest(stamp_ns)
        if not self._limits.due("scan", stamp_ns):
            return
        points, beams = scan_points(ranges_m, angle_min_rad, angle_increment_rad, range_limits_m)
        self._sweeps.append(
            _Sweep(
                stamp_ns=stamp_ns,
                end_ns=stamp_ns + round(time_increment_s * len(ranges_m) * 1e9),
                points_body=transform_points(self._T_body_lidar, points),
                share=beams / max(len(ranges_m), 1),
            )
        )
        # The pose at a sweep's end is interpolated after the next pose; if none comes, use the last one.
        if len(self._sweeps) > _WAITING_SWEEPS or self._best_source() is None:
            self._draw_sweep(self._sweeps.popleft())

    def pose(self, source: str, stamp_ns: int, T_source_body: np.ndarray) -> None:
        """Draw the robot's pose [4, 4] from `source`, one of `SOURCES`.

        Poses of localization are in the odom frame, external poses in the map frame, wheel poses in a
        drifting frame of their own. The wheel frame is aligned to the map with the first pose of a better
        source.
        """
        self._update_newest(stamp_ns)
        self._poses[source].add(stamp_ns, T_source_body)
        best_source = self._best_source()
        T_map_body = self._T_map_source(source) @ T_source_body
        lift_m = np.array([0.0, 0.0, _LIFT_M[source]])
        self._extend_path(f"{WORLD}/path/{source}", stamp_ns, T_map_body[:3, 3] + lift_m, _COLOURS[source])
        if source == "localization":
            self._extend_path(_SMOOTH, stamp_ns, T_source_body[:3, 3], _SMOOTH_COLOUR)
        if source != best_source:
            return
        if self._limits.due("pose", stamp_ns, source):
            T_odom_body = inverse(self._T_map_odom) @ T_map_body
            self._writer.log(BODY, _transform(T_odom_body), stamp_ns=stamp_ns)
        while self._sweeps and stamp_ns >= self._sweeps[0].end_ns:
            self._draw_sweep(self._sweeps.popleft())

    def _extend_path(
        self, entity: str, stamp_ns: int, point_m: np.ndarray, colour: tuple[int, int, int]
    ) -> None:
        path = self._paths[entity]
        path.add(point_m)
        if self._limits.due("path", stamp_ns, entity):
            strip = rr.LineStrips3D([path.points_m], colors=colour, radii=rr.Radius.ui_points(1.5))
            self._writer.log(entity, strip, stamp_ns=stamp_ns)

    def correction(self, stamp_ns: int, T_map_odom: np.ndarray) -> None:
        """Draw the odom frame in the map frame: `T_map_odom` [4, 4]."""
        self._T_map_odom = T_map_odom
        self._writer.log(f"{WORLD}/odom", _transform(T_map_odom), stamp_ns=self._not_before(stamp_ns))

    # --- the map ---

    def anchors(self, stamp_ns: int, anchor_ids: np.ndarray, T_map_anchor: np.ndarray) -> None:
        """Draw submaps: `anchor_ids` int64 [N], `T_map_anchor` float64 [N, 4, 4]."""
        if not self._limits.due("anchors", stamp_ns):
            return
        arrows = rr.Arrows3D(
            origins=T_map_anchor[:, :3, 3], vectors=0.3 * T_map_anchor[:, :3, 0],
            labels=[str(i) for i in anchor_ids], show_labels=False, colors=_ANCHOR,
        )  # fmt: skip
        self._writer.log(f"{WORLD}/anchors", arrows, stamp_ns=stamp_ns)

    def finish(self) -> None:
        """Draw the scans that still wait for a pose."""
        while self._sweeps:
            self._draw_sweep(self._sweeps.popleft())

    # --- frames and times ---

    def _update_newest(self, stamp_ns: int) -> None:
        """Update the newest measurement time; an earlier stamp by a loop of the playback resets it."""
        if self.newest_ns is None or not self.newest_ns - _LOOP_RESTART_NS < stamp_ns <= self.newest_ns:
            self.newest_ns = stamp_ns

    def _best_source(self) -> str | None:
        return next((name for name in SOURCES if self._poses[name]), None)

    def _T_map_source(self, source: str) -> np.ndarray:
        if source == "localization":
            return self._T_map_odom
        if source == "external":
            return np.eye(4)
        if self._T_map_wheel is None:
            better = next((n for n in SOURCES[:2] if self._poses[n]), None)
            if better is None:
                return np.eye(4)
            T_map_body = self._T_map_source(better) @ self._poses[better].newest[1]
            self._T_map_wheel = T_map_body @ inverse(self._poses["wheel"].newest[1])
            self._paths[f"{WORLD}/path/wheel"].clear()
        return self._T_map_wheel

    def _draw_sweep(self, sweep: _Sweep) -> None:
        best_source = self._best_source()
        ends = [np.eye(4), np.eye(4)]
        if best_source is not None:
            first, last = (self._poses[best_source].at(t) for t in (sweep.stamp_ns, sweep.end_ns))
            if first is None or last is None:
                return  # no pose of that time: nowhere to draw it
            ends = [self._T_map_source(best_source) @ T for T in (first, last)]
        points_map = sweep_to_world(sweep.points_body, sweep.share, *ends)
        points = rr.Points3D(points_map.astype(np.float32), colors=_SCAN, radii=rr.Radius.ui_points(2.0))
        self._writer.log(SCAN, points, stamp_ns=sweep.stamp_ns)

    def _not_before(self, stamp_ns: int) -> int:
        """Return the time (ns) at which to draw a result: `stamp_ns`, but not before the newest measurement.

        An optimisation has the stamp of its input, which is older than the newest measurement.
        """
        return stamp_ns if self.newest_ns is None else max(stamp_ns, self.newest_ns)


def _transform(T: np.ndarray) -> rr.Transform3D:
    return rr.Transform3D(
        translation=T[:3, 3], quaternion=rr.Quaternion(xyzw=quat_xyzw_from_matrix(T[:3, :3]))
    )


def _rows(data: np.ndarray, height: int, row_bytes: int, step_bytes: int) -> np.ndarray:
    """Return a raw image without the padding of its rows, uint8 [height, row_bytes].

    `step_bytes`: bytes from one row to the next, including padding.

    Raises:
        ValueError: fewer bytes than the image needs.
    """
    step = step_bytes or row_bytes
    if step < row_bytes or data.size < step * (height - 1) + row_bytes:
        raise ValueError(f"{data.size} bytes are too few for {height} rows of {row_bytes} (step {step})")
    return np.lib.stride_tricks.as_strided(data, (height, row_bytes), (step, 1))
