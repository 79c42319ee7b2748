"""The page's server for one map: what `beamsplat view` runs."""

from __future__ import annotations

import threading
from pathlib import Path
from types import TracebackType

from beamsplat.common.config.alerts import AlertConfig
from beamsplat.common.config.deployment import Deployment, load_deployment
from beamsplat.common.errors import UserError
from beamsplat.common.messages import Health, Message
from beamsplat.common.security.logins import OPERATOR, login_of
from beamsplat.common.zenoh.bus import open_session
from beamsplat.services.page.access import PageAccess, page_address
from beamsplat.services.page.alerting import Alerting
from beamsplat.services.page.fleet import Fleet
from beamsplat.services.page.intake import RobotIntake
from beamsplat.services.page.live_session import FleetSubscriptions
from beamsplat.services.page.map3d.live_session import LiveMap
from beamsplat.services.page.map3d.source import MapSource
from beamsplat.services.page.node import TOPICS
from beamsplat.services.page.server import PageServer
from beamsplat.services.page.view import PageState
from beamsplat.tools.cli.options import session_folder
from beamsplat.tools.view.saved_map import ply_source, session_source

_CONNECT_S = 2.0
_IMAGES_HZ, _MAP_HZ, _ROBOT_HZ = 2.0, 0.5, 5.0  # as the page's defaults
_WIDEST_PX = 640
_LIVE_MB = 500.0  # for the map of a running system


class MapViewer:
    """Serves one map until it is closed; `address` is its page."""

    def __init__(self, path: Path, bind: str, port: int, up: str = "z") -> None:
        """Open a map and serve it.

        Args:
            path: a session (or the folder of a demo), a 3DGS .ply file, or the deployment file (.toml) of a
                running system.
            port: 0 = any free one.
            up: axis of a .ply file that points up.

        Raises:
            UserError: there is no such map, it cannot be read, no system answers, or the port is in use.
        """
        self._system: RunningSystem | None = None
        self._source: MapSource | None = None
        if path.suffix == ".ply":
            self._source = ply_source(path, up)
        elif path.is_file() and path.suffix == ".toml":
            self._system = RunningSystem(load_deployment(path))
        elif path.exists():
            self._source = session_source(session_folder(path))
        else:
            raise UserError(
                f"{path}: there is no such file or folder: give the folder of a session, a .ply file of 3D "
                "Gaussian splats, or the deployment file (.toml) of a running system"
            )
        name = path.resolve().stem if self._system is None else self._system.fleet.own
        fleet = Fleet(name, _new_state) if self._system is None else self._system.fleet
        self._alerting = Alerting(fleet, AlertConfig())  # shows none: it is not started
        self._server = PageServer(
            fleet,
            self._alerting,
            _refuse,
            PageAccess(),
            _ROBOT_HZ,
            self._make_map,
            saved=self._system is None,
        )
        try:
            chosen = self._server.start(bind, port, None)
        except OSError as error:
            self.close()
            raise UserError(
                f"cannot listen at {bind}:{port} ({error.strerror}): choose another port with --port PORT "
                "(0: any free port)"
            ) from error
        self.address = page_address(bind, chosen) + "view"

    def _make_map(self, robot: str, state: PageState) -> MapSource:
        if self._source is not None:
            return self._source
        assert self._system is not None
        return self._system.live_map(state)

    def check(self) -> None:
        """Raise the exception that ended a part of the server, if any."""
        self._server.check()

    def close(self) -> None:
        """Stop serving."""
        self._server.close()
        self._alerting.close()
        if self._system is not None:
            self._system.close()

    def __enter__(self) -> MapViewer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class RunningSystem:
    """The messages of one robot of a running deployment, and its map."""

    def __init__(self, deployment: Deployment) -> None:
        """Connect. Raises UserError if no router answers."""
        self._endpoints, self._login = deployment.router.listen, login_of(deployment.security, OPERATOR)
        self._session = open_session(self._endpoints, _CONNECT_S, login=self._login)
        self.fleet = Fleet(deployment.robot, _new_state)
        self._intake = RobotIntake(self.fleet.own_state, _WIDEST_PX, _ignore)
        self._lock = threading.Lock()
        self._subscriptions = FleetSubscriptions(
            self._session, "", TOPICS, self._take, _ignore, robots=deployment.robot
        )

    def live_map(self, state: PageState) -> LiveMap:
        """Return the map of the system's mapper; it connects when somebody looks at it."""
        return LiveMap(
            self.fleet.own, lambda: open_session(self._endpoints, _CONNECT_S, login=self._login),
            state.mapper_instance, lambda: state.camera, _LIVE_MB, _ignore,
        )  # fmt: skip

    def close(self) -> None:
        """Close the session."""
        self._session.close()

    def _take(self, robot: str, topic: str, message: Message) -> None:
        with self._lock:
            if isinstance(message, Health):
                self._intake.take_health(message)
            else:
                self._intake.take(topic, message)


def _new_state() -> PageState:
    return PageState(_IMAGES_HZ, _MAP_HZ)


def _ignore(reason: str) -> None:
    """Ignore what cannot be used: the nodes of the system count it."""


def _refuse(action: str, node: str, parameters: dict[str, str]) -> str:
    raise ValueError("this page takes no commands")
