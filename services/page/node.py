"""The page node: a web page for any browser that shows the running system.

The node publishes nothing. Users with the token can restart and swap nodes. Publishers never wait for this
node.
"""

from __future__ import annotations

import json
import logging
import ssl
from functools import partial
from pathlib import Path
from typing import Annotated
from urllib.parse import quote

from pydantic import Field, SecretStr, field_validator

from beamsplat.common.config.base import Remote
from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.errors import UserError
from beamsplat.common.mapfiles.grid_tiles import GridSource, TiledGrid
from beamsplat.common.messages import (
    Answer,
    Correction,
    ExternalPose,
    FusedDepth,
    GridTile,
    Health,
    Image,
    MapPreview,
    MapStatus,
    Odometry,
    Rig,
    Scan,
    WheelOdometry,
)
from beamsplat.common.runtime.node import Input, Node, Outputs, QueryFunction
from beamsplat.services.page.access import PageAccess, own_host_names
from beamsplat.services.page.images import EncodedImage, encode_camera_image, encode_depth, encode_tiles
from beamsplat.services.page.server import PageServer
from beamsplat.services.page.view import PageState

log = logging.getLogger(__name__)

_MIN_TOKEN_CHARS = 12
# Command of the page -> query to the node, and its timeout (s). The successor of a swap may load a model.
_COMMANDS = {
    "restart": ("restart", 10.0), "params": ("params", 10.0),
    "swap": ("swap", 150.0), "cold swap": ("swap", 150.0),
}  # fmt: skip
Hz = Annotated[float, Field(gt=0.0, le=30.0)]


class PageConfig(NodeConfig):
    """Options of the page.

    With `bind = "0.0.0.0"` everyone who can reach this machine can open the page. Without a certificate,
    images and token are sent unencrypted.
    """

    bind: str = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535)] = 8420  # 0 = any free one
    names: tuple[str, ...] = ()  # host names of this machine in addresses, besides its own host name
    token: SecretStr = SecretStr("")  # required for commands; "": commands are disabled
    certificate: Path | None = None  # PEM; with it the page uses https
    certificate_key: Path | None = None
    picture_hz: Remote[Hz] = 2.0
    map_hz: Remote[Hz] = 0.5
    robot_hz: Remote[Hz] = 5.0
    widest_px: Remote[Annotated[int, Field(ge=64, le=4096)]] = 640  # wider images are scaled down

    @field_validator("token")
    @classmethod
    def _long_enough(cls, token: SecretStr) -> SecretStr:
        if 0 < len(token.get_secret_value()) < _MIN_TOKEN_CHARS:
            raise ValueError(
                f"a token needs at least {_MIN_TOKEN_CHARS} characters; an empty one disables commands"
            )
        return token


class PageNode(Node):
    """Stores the newest message of each input for the page, and executes commands of users."""

    name = "page"
    Config = PageConfig
    config: PageConfig
    inputs = (
        Input("rig", "latched"),
        Input("wheel/odometry", "latest"),
        Input("lidar/scan", "latest"),
        Input("camera/image", "latest"),
        Input("external/pose", "latest"),
        Input("localization/odometry", "latest"),
        Input("localization/correction", "latched"),
        Input("localization/grid", "every"),
        Input("fusion/depth", "latest"),
        Input("mapping/preview", "latest"),
        Input("mapping/status", "latest"),
    )
    _ask: QueryFunction | None = None

    def set_query_function(self, ask: QueryFunction) -> None:
        self._ask = ask

    def check_resources(self) -> None:
        _tls(self.config.certificate, self.config.certificate_key)

    def configure(self) -> None:
        c = self.config
        self._state = PageState(c.picture_hz, c.map_hz)
        self._grid = TiledGrid()
        names = own_host_names() | {name.lower() for name in c.names}
        access = PageAccess(c.token.get_secret_value(), names)
        tls = _tls(c.certificate, c.certificate_key)
        self._server = PageServer(self._state, self._command, access, c.robot_hz)
        try:
            port = self._server.start(c.bind, c.port, tls)
        except OSError as error:
            raise UserError(
                f"page: cannot listen at {c.bind}:{c.port} ({error.strerror}): choose another port with "
                "--set page.port=PORT (0: any free port)"
            ) from error
        host = "127.0.0.1" if c.bind in ("0.0.0.0", "::") else c.bind
        self._address = f"{'https' if tls else 'http'}://{f'[{host}]' if ':' in host else host}:{port}/"
        self.detail = f"open {self._address}"
        log.info("%s", self.detail)

    def close(self) -> None:
        if hasattr(self, "_server"):
            self._server.close()

    def _command(self, action: str, node: str, parameters: dict[str, str]) -> str:
        """Execute a command of an authorized user, in a thread of the server; return the result text.

        Raises:
            ValueError: unknown command or node, or the node rejects it.
        """
        if action == "check":
            return "the token is correct"
        if action not in _COMMANDS or not node.replace("_", "").replace("-", "").isalnum():
            raise ValueError(f"no command {action!r} for node {node!r}; commands: {', '.join(_COMMANDS)}")
        if self._ask is None:
            raise ValueError("no bus: commands are not possible")
        verb, timeout_s = _COMMANDS[action]
        parameters_sent = {}
        if verb == "swap":
            changes = [f"{option}={value}" for option, value in parameters.items()]
            parameters_sent = {
                "set": quote(json.dumps(changes)),
                **({"cold": "1"} if action == "cold swap" else {}),
            }
        if verb != "params":
            log.info("%s %s, commanded by the page", action, node)
        answers = self._ask(node, verb, parameters_sent, timeout_s)
        return " ".join(answer.text for answer in answers if isinstance(answer, Answer))

    # --- inputs ---

    def on_health(self, health: Health) -> None:
        self._state.health(health)
        if health.node == self.name:
            self._server.check()
            viewers = len(self._server.events)
            refused = "".join(f"; {n} {what}" for what, n in self._server.refused().items() if n)
            for what, count in self._server.refused().items():
                self.rejections.set(what, count)
            self.detail = (
                f"open {self._address}; {viewers} {'viewer' if viewers == 1 else 'viewers'}{refused}"
            )

    def on_rig(self, rig: Rig) -> Outputs:
        if rig.lidar is not None:
            self._state.lidar(rig.lidar.T_body_lidar)
        return iter(())

    def on_wheel_odometry(self, m: WheelOdometry) -> Outputs:
        self._state.pose("wheel", m.stamp_ns, m.T_odom_body)
        return iter(())

    def on_lidar_scan(self, m: Scan) -> Outputs:
        self._state.scan(
            m.stamp_ns, m.ranges_m, m.angle_min_rad, m.angle_increment_rad, (m.range_min_m, m.range_max_m)
        )
        return iter(())

    def on_camera_image(self, m: Image) -> Outputs:
        size_px = (m.width_px, m.height_px)
        self._state.images["camera"].update(
            partial(encode_camera_image, m.data, m.encoding, size_px, m.step_bytes, self.config.widest_px)
        )
        return iter(())

    def on_external_pose(self, m: ExternalPose) -> Outputs:
        self._state.pose("external", m.stamp_ns, m.T_map_body)
        return iter(())

    def on_localization_odometry(self, m: Odometry) -> Outputs:
        self._state.pose("localization", m.stamp_ns, m.T_odom_body)
        self._state.service_status("localization", m.status, detail=m.detail, metric=m.metric)
        return iter(())

    def on_localization_correction(self, m: Correction) -> Outputs:
        self._state.correction(m.T_map_odom)
        return iter(())

    def on_localization_grid(self, m: GridTile) -> Outputs:
        """Store a tile of the grid; with the last tile of an update, offer the whole grid to the pages."""
        source = GridSource(m.map_uuid, m.since_ns, m.resolution_m, m.size)
        try:
            self._grid.add(source, m.row, m.column, m.packed.tobytes())
        except ValueError as error:
            self.rejections.add(str(error))
        if m.remaining == 0:
            self._state.images["map"].update(partial(encode_tiles, self._grid.copy()))
        return iter(())

    def on_fusion_depth(self, m: FusedDepth) -> Outputs:
        self._state.service_status(
            "fusion", "ok" if m.status == "ok" else "refused", detail=m.status.removeprefix("ok"),
            scale=m.scale, scale_sigma=m.scale_sigma, inlier_share=m.inlier_share, residual_m=m.residual_m,
        )  # fmt: skip
        self._state.scale(m.scale, m.scale_sigma)
        if m.depth_m.size:
            self._state.images["depth"].update(partial(encode_depth, m.depth_m, self.config.widest_px))
        return iter(())

    def on_mapping_preview(self, m: MapPreview) -> Outputs:
        self._state.images["render"].update(lambda: EncodedImage(m.render.tobytes(), "image/jpeg", {}))
        return iter(())

    def on_mapping_status(self, m: MapStatus) -> Outputs:
        self._state.service_status(
            "mapping", "ok" if m.status == "ok" else "refused", detail=m.status.removeprefix("ok"),
            keyframes=m.keyframes, gaussians=m.gaussians, psnr_db=m.psnr_db, depth_error_m=m.depth_error_m,
        )  # fmt: skip
        return iter(())


def _tls(certificate: Path | None, key: Path | None) -> ssl.SSLContext | None:
    if certificate is None and key is None:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_cert_chain(str(certificate), None if key is None else str(key))
    except (OSError, ssl.SSLError) as error:
        raise UserError(
            f"page: certificate = {certificate}, certificate_key = {key} cannot be used ({error}): "
            "both must be PEM files, and the key must belong to the certificate"
        ) from error
    return context
