"""The page node: a web page for any browser that shows the running system.

The node publishes nothing. Users with the token can restart and swap nodes. Publishers never wait for this
node.
"""

from __future__ import annotations

import json
import logging
import ssl
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import quote

import zenoh
from pydantic import Field, SecretStr, field_validator

from beamsplat.common.config.alerts import AlertConfig
from beamsplat.common.config.base import Remote
from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.errors import UserError
from beamsplat.common.messages import Answer, Health, Message
from beamsplat.common.messages.header import local_clock_id
from beamsplat.common.runtime.live_settings import LiveSettings
from beamsplat.common.runtime.node import Input, Node, Outputs, QueryFunction
from beamsplat.common.security.logins import login_of
from beamsplat.common.zenoh.bus import open_session
from beamsplat.services.page.access import PageAccess, own_host_names, page_address
from beamsplat.services.page.alerting import Alerting
from beamsplat.services.page.fleet import Fleet
from beamsplat.services.page.intake import RobotIntake
from beamsplat.services.page.live_session import FleetSubscriptions
from beamsplat.services.page.map3d.live_session import LiveMap
from beamsplat.services.page.map3d.source import MapSource
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
    map3d_mb: Annotated[float, Field(ge=1.0, le=100_000.0)] = 200.0  # memory for the 3D map of each robot
    widest_px: Remote[Annotated[int, Field(ge=64, le=4096)]] = 640  # wider images are scaled down
    fleet: bool = False  # show all robots that this router hears: for the page of an edge server
    alerts: AlertConfig = AlertConfig()  # table [nodes.page.alerts]

    @field_validator("token")
    @classmethod
    def _long_enough(cls, token: SecretStr) -> SecretStr:
        if 0 < len(token.get_secret_value()) < _MIN_TOKEN_CHARS:
            raise ValueError(
                f"a token needs at least {_MIN_TOKEN_CHARS} characters; an empty one disables commands"
            )
        return token


_INPUTS = (
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
TOPICS = tuple(entry.topic for entry in _INPUTS)  # what the page shows of a robot, besides health


def _handler(topic: str) -> Callable[[Any, Message], Outputs]:
    def take(self: PageNode, message: Message) -> Outputs:
        self._intake.take(topic, message)
        return iter(())

    return take


# A handler for each input: `RobotIntake` tells what is stored.
_Handlers: Any = type("_Handlers", (), {i.row.handler: _handler(i.topic) for i in _INPUTS})


class PageNode(_Handlers, Node):
    """Stores the newest message of each input for the page, and executes commands of users."""

    name = "page"
    Config = PageConfig
    config: PageConfig
    inputs = _INPUTS
    _ask: QueryFunction | None = None

    def set_query_function(self, ask: QueryFunction) -> None:
        self._ask = ask

    def check_resources(self) -> None:
        _tls(self.config.certificate, self.config.certificate_key)

    def configure(self) -> None:
        c, live = self.config, self.live_settings
        robot = "robot" if live is None else live.robot
        self._fleet = Fleet(robot, lambda: PageState(c.picture_hz, c.map_hz))
        self._intake = self._new_intake(self._fleet.own_state)
        self._intakes: dict[str, RobotIntake] = {}  # of other robots
        self._fleet_lock = threading.Lock()
        names = own_host_names() | {name.lower() for name in c.names}
        access = PageAccess(c.token.get_secret_value(), names)
        tls = _tls(c.certificate, c.certificate_key)
        file = None if live is None else live.run_dir / "alerts.json"
        self._alerting = Alerting(self._fleet, c.alerts, local_clock_id(), file)
        self._server = PageServer(
            self._fleet, self._alerting, self._command, access, c.robot_hz, self._make_map
        )
        self._listen(tls)
        self._alerting.start()
        if c.fleet and live is not None:
            self._subscribe_to_fleet(live)

    def _listen(self, tls: ssl.SSLContext | None) -> None:
        c = self.config
        try:
            port = self._server.start(c.bind, c.port, tls)
        except OSError as error:
            raise UserError(
                f"page: cannot listen at {c.bind}:{c.port} ({error.strerror}): choose another port with "
                "--set page.port=PORT (0: any free port)"
            ) from error
        self._address = page_address(c.bind, port, "https" if tls else "http")
        self.detail = f"open {self._address}"
        log.info("%s", self.detail)

    def _make_map(self, robot: str, state: PageState) -> MapSource:
        live = self.live_settings
        if live is None:
            return MapSource()
        return LiveMap(
            robot, lambda: self._open_session(live), state.mapper_instance, lambda: state.camera,
            self.config.map3d_mb, self.rejections.add,
        )  # fmt: skip

    def _open_session(self, live: LiveSettings) -> zenoh.Session:
        login = login_of(live.security, self.name)
        return open_session(live.endpoints, should_stop=self.must_stop, login=login)

    def _subscribe_to_fleet(self, live: LiveSettings) -> None:
        """Open a session for the messages of all other robots: those of a node are of its own robot."""
        self._session = self._open_session(live)
        self._subscriptions = FleetSubscriptions(
            self._session, live.robot, TOPICS, self._take_of_other, self.rejections.add
        )

    def close(self) -> None:
        if hasattr(self, "_session"):
            self._session.close()
        if hasattr(self, "_alerting"):
            self._alerting.close()
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
        self._intake.take_health(health)
        if health.node != self.name:
            return
        self._server.check()
        viewers, robots = self._server.viewers, len(self._fleet.states())
        for what, count in self._server.refused().items():
            self.rejections.set(what, count)
        self.rejections.set("messages of other robots: too many robots", self._fleet.ignored)
        texts = [f"open {self._address}", f"{viewers} {'viewer' if viewers == 1 else 'viewers'}"]
        texts += [f"{robots} robots"] if robots > 1 else []
        counts = {**self._server.refused(), **self._server.reduced_chunks()}
        texts += [f"{n} {what}" for what, n in counts.items() if n]
        self.detail = "; ".join(texts)

    def _take_of_other(self, robot: str, topic: str, message: Message) -> None:
        """Store a message of another robot; called from the threads of the session of the fleet."""
        with self._fleet_lock:
            state = self._fleet.state_of(robot)
            if state is None:
                return
            intake = self._intakes.get(robot)
            if intake is None or intake.state is not state:
                known = self._fleet.states()
                self._intakes = {name: i for name, i in self._intakes.items() if name in known}
                intake = self._intakes[robot] = self._new_intake(state)
            if isinstance(message, Health):
                intake.take_health(message)
            else:
                intake.take(topic, message)

    def _new_intake(self, state: PageState) -> RobotIntake:
        return RobotIntake(state, self.config.widest_px, self.rejections.add)


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
