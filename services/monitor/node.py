"""The monitor node: shows the running system in rerun. Publishers never wait for this node."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from beamsplat.common.config.base import Remote
from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.errors import UserError
from beamsplat.common.files.persist import check_can_write
from beamsplat.common.geometry.tracks import RateLimit
from beamsplat.common.mapfiles.grid_tiles import GridSource
from beamsplat.common.messages import FusedDepth, Health, MapAnchors, MapChunk, MapStatus, Odometry, Rig
from beamsplat.common.messages.header import Header
from beamsplat.common.runtime.node import Input, Node, Output
from beamsplat.services.monitor.depth_layer import DepthLayer
from beamsplat.services.monitor.grid_layer import GridLayer
from beamsplat.services.monitor.layout import layout
from beamsplat.services.monitor.map_layer import MapLayer
from beamsplat.services.monitor.panel import HealthPanel, NodeReport
from beamsplat.services.monitor.rerun_writer import RerunWriter
from beamsplat.services.monitor.scene import Scene, SceneStyle
from beamsplat.services.monitor.web import allowed_origins, free_port, serve_page

log = logging.getLogger(__name__)

Hz = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Port = Annotated[int, Field(ge=0, le=65535)]
Megabytes = Annotated[int, Field(gt=0)]


class MonitorConfig(NodeConfig):
    """Options of the monitor.

    `view`: a web viewer ("serve"), a viewer window on this machine ("spawn"), or none; `save`: also write a
    file. Rates are upper limits in measurement time; a rate of 0 disables the drawing.
    """

    # Lower CPU priority than what it shows: on a busy machine the picture is late, not the robot.
    nice: Annotated[int, Field(ge=0, le=19)] = 5
    view: Literal["none", "spawn", "serve"] = "serve"
    save: Path | None = None
    bind: str = "127.0.0.1"  # "0.0.0.0": anyone who can reach this machine can see it, without encryption
    grpc_port: Port = 9876  # 0 = any free one
    web_port: Port = 9090
    viewer_memory_mb: Megabytes = 512  # history for viewers that connect later
    save_limit_mb: Megabytes = 8000  # at this size the file is closed
    keep_free_mb: Megabytes = 500  # on the disk; with less the file is closed
    image_hz: Remote[Hz] = 10.0
    scan_hz: Remote[Hz] = 10.0
    pose_hz: Remote[Hz] = 20.0
    path_hz: Remote[Hz] = 1.0
    grid_hz: Remote[Hz] = 0.5
    anchors_hz: Remote[Hz] = 1.0
    depth_hz: Remote[Hz] = 2.0
    splats_hz: Remote[Hz] = 0.5  # of each chunk of the map
    clouds: Annotated[int, Field(ge=1)] = 40  # keyframes whose points are shown
    path_points: Annotated[int, Field(ge=16)] = 2000
    path_step_m: Remote[Annotated[float, Field(gt=0.0)]] = 0.05
    body_size_m: tuple[float, float, float] = (0.4, 0.3, 0.25)  # length, width, height of the robot


def _draw_rig(scene: Scene, panel: HealthPanel, rig: Rig) -> None:
    if rig.camera is not None:
        size_px = (rig.camera.width_px, rig.camera.height_px)
        scene.camera(rig.camera.K, size_px, rig.camera.T_body_camera)
    if rig.lidar is not None:
        scene.lidar(rig.lidar.T_body_lidar)
    for sentence in rig.assumed:
        panel.log(f"rig: {sentence}", scene.newest_ns, "WARN")


def _draw_odometry(scene: Scene, panel: HealthPanel, m: Odometry) -> None:
    scene.pose("localization", m.stamp_ns, m.T_odom_body)
    panel.status("localization", m.status, m.detail, m.stamp_ns)


def _draw_depth(view: DepthLayer, panel: HealthPanel, m: FusedDepth) -> None:
    if m.depth.size and view.depth_is_due(m.stamp_ns):
        view.depth(m.stamp_ns, m.depth_m)
    panel.status("fusion", "ok" if m.status == "ok" else "refused", m.status.removeprefix("ok"), m.stamp_ns)


def _draw_status(view: MapLayer, panel: HealthPanel, m: MapStatus) -> None:
    view.metrics(m.stamp_ns, m.foretold_psnr_db, m.psnr_db, m.depth_error_m)
    panel.status("mapping", "ok" if m.status == "ok" else "refused", m.status.removeprefix("ok"), m.stamp_ns)


Draw = Callable[[Any, HealthPanel, Any], None]

# Topic -> how to draw it in the scene. These deliveries never block a publisher.
SCENE: dict[Input, Draw] = {
    Input("rig", "latched"): _draw_rig,
    Input("camera/image", "latest"): lambda scene, _, m: scene.image(
        m.stamp_ns, m.data, m.encoding, (m.width_px, m.height_px), m.step_bytes
    ),
    Input("lidar/scan", "latest"): lambda scene, _, m: scene.scan(
        m.stamp_ns, m.ranges_m, m.angle_min_rad, m.angle_increment_rad, m.time_increment_s,
        (m.range_min_m, m.range_max_m),
    ),
    Input("wheel/odometry", "latest"): lambda scene, _, m: scene.pose("wheel", m.stamp_ns, m.T_odom_body),
    Input("external/pose", "latest"): lambda scene, _, m: scene.pose("external", m.stamp_ns, m.T_map_body),
    Input("localization/odometry", "latest"): _draw_odometry,
    Input("localization/correction", "latched"): lambda scene, _, m: scene.correction(
        m.stamp_ns, m.T_map_odom
    ),
    Input("localization/anchors", "latched"): lambda scene, _, m: scene.anchors(
        m.stamp_ns, m.anchor_ids, m.T_map_anchor
    ),
}  # fmt: skip
GRID: dict[Input, Draw] = {
    Input("localization/grid", "every"): lambda view, _, m: view.tile(
        m.stamp_ns, GridSource(m.map_uuid, m.since_ns, m.resolution_m, m.size), (m.row, m.column),
        m.packed.tobytes(), m.remaining == 0,
    ),
}  # fmt: skip
DEPTH: dict[Input, Draw] = {
    Input("fusion/depth", "latest"): _draw_depth,
    Input("fusion/cloud", "latest"): lambda view, _, m: view.cloud(m.stamp_ns, m.points_odom_m, m.colours),
}
CHUNK, ANCHORS = Input("mapping/chunk", "every"), Input("mapping/anchors", "latched")
MAP: dict[Input, Draw] = {
    Input("mapping/preview", "latest"): lambda view, _, m: view.render(m.stamp_ns, m.render),
    Input("mapping/status", "latest"): _draw_status,
}


def _handler(view: str, draw: Draw) -> Callable[[MonitorNode, Any], tuple[Output, ...]]:
    return lambda self, message: _draw_safely(self, view, draw, message)


def _draw_safely(monitor: MonitorNode, view: str, draw: Draw, message: Any) -> tuple[Output, ...]:
    try:
        draw(getattr(monitor, view), monitor.panel, message)
    except ValueError as error:  # a valid message that cannot be drawn
        monitor._not_drawn(type(message).__name__, str(error), message.stamp_ns)
    monitor.detail = monitor.writer.status
    return ()


_Handlers: Any = type(
    "_Handlers",
    (),
    {
        entry.row.handler: _handler(view, draw)
        for view, rows in (("scene", SCENE), ("grid_layer", GRID), ("depth_layer", DEPTH), ("map_layer", MAP))
        for entry, draw in rows.items()
    },
)


class MonitorNode(_Handlers, Node):
    """Draws the topics of `SCENE`, `GRID`, `DEPTH` and `MAP`, and the health of all nodes."""

    name = "monitor"
    Config = MonitorConfig
    config: MonitorConfig
    inputs = (*SCENE, *GRID, *DEPTH, CHUNK, ANCHORS, *MAP)
    _header: Header | None = None

    def check_resources(self) -> None:
        if self.config.save is not None:
            check_can_write(self.config.save, "save", read_only_disk=True)

    def configure(self) -> None:
        c = self.config
        if c.view == "none" and c.save is None:
            raise UserError(
                'monitor: view = "none" without save shows nothing: choose a view, or set save to a file'
            )
        self.writer = RerunWriter()
        try:
            self._open()
        except (RuntimeError, OSError) as error:
            self.writer.close()
            raise UserError(f"monitor: {error}") from error
        kinds = ("image", "scan", "pose", "path", "grid", "anchors", "depth", "splats")
        limits = RateLimit({"health": 1.0, **{kind: getattr(c, f"{kind}_hz") for kind in kinds}})
        self.panel = HealthPanel(self.writer, limits)
        self.scene = Scene(self.writer, limits, SceneStyle(c.path_points, c.path_step_m, c.body_size_m))
        self.grid_layer = GridLayer(self.writer, limits)
        self.depth_layer = DepthLayer(self.writer, limits, c.clouds)
        self.map_layer = MapLayer(self.writer, limits)
        self.detail = self.writer.status
        log.info("%s", self.detail)

    def _open(self) -> None:
        """Open the file and the viewer.

        Raises:
            RuntimeError, OSError: one of them cannot be opened; the text contains the remedy.
        """
        c, writer = self.config, self.writer
        if c.save is not None:
            writer.save(c.save, layout(), limit_mb=c.save_limit_mb, keep_free_mb=c.keep_free_mb)
        if c.view == "none":
            return
        grpc_port, web_port = _port(c.bind, "grpc_port", c.grpc_port), 0
        origins: list[str] = []
        if c.view == "serve":
            web_port = _port("0.0.0.0", "web_port", c.web_port)
            origins = allowed_origins(c.bind, web_port)
        address = writer.serve(
            layout(), bind=c.bind, port=grpc_port, origins=origins, memory_mb=c.viewer_memory_mb
        )
        if c.view == "serve":
            writer.notes.append(f"open {serve_page(c.bind, web_port, grpc_port)}")
        else:
            writer.spawn(address, c.viewer_memory_mb)
            writer.notes.append(f"viewer at {address}")

    def on_header(self, header: Header) -> None:
        self._header = header

    def _not_drawn(self, kind: str, fault: str, stamp_ns: int | None) -> None:
        """Log and count a message that decodes, but cannot be drawn."""
        self.panel.log(fault, stamp_ns, "WARN")
        self.rejections.add(f"{kind} not drawn: {fault}")

    def on_mapping_chunk(self, message: MapChunk) -> tuple[Output, ...]:
        """Draw a chunk; the header tells which process of the mapper has sent it."""
        assert self._header is not None  # runners pass it before each message
        sent_by = self._header.instance

        def draw(view: MapLayer, _: HealthPanel, m: MapChunk) -> None:
            pose = (m.pose_revision, m.T_map_anchor)
            view.chunk(m.stamp_ns, sent_by, m.anchor_id, m.revision, pose, m.packed)

        return _draw_safely(self, "map_layer", draw, message)

    def on_mapping_anchors(self, message: MapAnchors) -> tuple[Output, ...]:
        """Move the chunks with their anchors."""
        assert self._header is not None  # runners pass it before each message
        sent_by = self._header.instance

        def draw(view: MapLayer, _: HealthPanel, m: MapAnchors) -> None:
            view.anchors(
                m.stamp_ns, sent_by, m.pose_revision, dict(zip(m.anchor_ids.tolist(), m.T_map_anchor))
            )

        return _draw_safely(self, "map_layer", draw, message)

    def on_health(self, health: Health) -> None:
        """Add the node's health to the table and the curves."""
        inputs = health.inputs
        report = NodeReport(
            node=health.node, instance=health.instance, wall_ns=health.stamp_ns, state=health.state,
            detail=health.detail, step_p50_ms=health.step_p50_ms, step_p95_ms=health.step_p95_ms,
            age_ms=max((i.age_ms for i in inputs), default=0.0),
            received=sum(i.received for i in inputs), sent=sum(o.sent for o in health.outputs),
            dropped=sum(i.dropped for i in inputs), lost=sum(i.lost for i in inputs),
            broken=sum(i.undecodable + i.stale for i in inputs),
            rss_mb=health.rss_mb, cpu_percent=health.cpu_percent,
        )  # fmt: skip
        self.panel.report(report, self.scene.newest_ns)
        self.detail = self.writer.status

    def drain(self) -> tuple[Output, ...]:
        self.scene.finish()
        self.grid_layer.finish()
        for fault in self.map_layer.finish():
            self._not_drawn("MapChunk", fault, self.scene.newest_ns)
        self.writer.flush()
        return ()

    def close(self) -> None:
        writer = getattr(self, "writer", None)
        if writer is not None:
            writer.close()


def _port(bind: str, option: str, port: int) -> int:
    try:
        return free_port(bind, port)
    except OSError as error:
        raise OSError(
            f"cannot listen at {bind}:{port} ({error.strerror}): another viewer may be running. "
            f"Choose another port with --set monitor.{option}=PORT (0: any free port)"
        ) from error
