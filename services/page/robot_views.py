"""The views of all robots that a page knows, each with its 3D map; made when they are needed."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from http import HTTPStatus
from typing import Any

from beamsplat.services.page.alerting import Alerting
from beamsplat.services.page.fleet import Fleet
from beamsplat.services.page.map3d.source import MapSource
from beamsplat.services.page.responses import RefusedRequest
from beamsplat.services.page.robot_view import RobotView
from beamsplat.services.page.view import PageState

MapMaker = Callable[[str, PageState], MapSource]  # (robot, its state) -> its 3D map


class RobotViews:
    """Views by robot; used in the server's thread, except for the counts."""

    def __init__(self, fleet: Fleet, alerting: Alerting, commands: bool, make_map: MapMaker) -> None:
        """Create the views.

        Args:
            commands: whether users can command the own robot.
            make_map: called once for each robot.
        """
        self._fleet, self._alerting, self._commands, self._make_map = fleet, alerting, commands, make_map
        self._encoder = ThreadPoolExecutor(1, "page-encoder")
        self._views: dict[str, RobotView] = {}

    def of(self, robot: str) -> RobotView:
        """Return the view of a robot. Raises RefusedRequest if the page does not know it."""
        state = self._fleet.states().get(robot)
        if state is None:
            raise RefusedRequest(HTTPStatus.NOT_FOUND, "no robot with this name is known: see /robots")
        view = self._views.get(robot)
        if view is None or view.state is not state:  # new, or forgotten and heard again
            if view is not None:
                self._close_map(view)
            facts, map3d = partial(self._facts, robot), self._make_map(robot, state)
            view = self._views[robot] = RobotView(state, facts, self._encoder, map3d)
        return view

    def with_viewers(self) -> list[RobotView]:
        """Return the views that somebody looks at; those of forgotten robots are removed."""
        known = self._fleet.states()
        for name in [name for name, view in self._views.items() if name not in known and not view.events]:
            self._close_map(self._views.pop(name))
        return [view for view in self._views.values() if view.events]

    def close(self) -> None:
        """Discard waiting images and close the 3D maps."""
        self._encoder.shutdown(wait=False, cancel_futures=True)
        for view in self._views.values():
            view.map3d.close()

    # --- counts ---

    @property
    def viewers(self) -> int:
        """Number of open event streams of all robots."""
        return sum(len(view.events) for view in list(self._views.values()))

    def reduced_chunks(self) -> dict[str, int]:
        """Return how many chunks of the 3D maps are not shown in full detail, by reason."""
        maps = [view.map3d.map for view in list(self._views.values())]
        return {
            "chunks of the 3D map with less detail (map3d_mb)": sum(m.coarsened for m in maps),
            "chunks of the 3D map left out (map3d_mb)": sum(m.left_out for m in maps),
            "damaged chunks of the 3D map": sum(m.damaged for m in maps),
        }

    def _close_map(self, view: RobotView) -> None:
        """Close the map of a forgotten robot; closing a session takes a moment."""
        self._encoder.submit(view.map3d.close)

    def _facts(self, robot: str, view: RobotView) -> dict[str, Any]:
        page = {
            "robot": robot, "viewers": len(view.events), "overtaken": view.events.dropped,
            "commands": robot == self._fleet.own and self._commands, "robots": len(self._fleet.states()),
        }  # fmt: skip
        return {"page": page, "alerts": [alert.as_json() for alert in self._alerting.alerts(robot)]}
