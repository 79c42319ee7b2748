"""The uplink node: runs on the robot and forwards the topics marked `uplink` to the edge's router, and back.

The robot never waits for this node: the node also runs without a link, and connects as soon as there is one.
Messages missed during an outage are sent again by their publisher (keyframes) or recovered from a cache in
this node (poses, anchors).
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Annotated

import zenoh
from pydantic import Field

from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.errors import UserError
from beamsplat.common.runtime.live_settings import LiveSettings
from beamsplat.common.runtime.node import Node, SourceItem
from beamsplat.common.security.logins import login_of
from beamsplat.common.zenoh.bridge import Bridge, BridgeSessions
from beamsplat.common.zenoh.bus import BULK_BUFFER_BYTES, URGENT_BUFFER_BYTES, open_link, open_session

_POLL_S = 0.1
_ATTEMPT_S = 1.0  # timeout of one attempt to connect
# Pauses between attempts: an attempt without keys, or to a port that nobody listens on, fails at once.
_BACK_OFF_S = (0.1, 0.2, 0.5, 1.0, 2.0)
_CLOSE_S = 1.0  # limit for closing all sessions, so that a node stops in time


class UplinkConfig(NodeConfig):
    """Options of the uplink: the address of the edge's router."""

    edge: Annotated[
        str, Field(pattern=r"^[a-z]+/\S+:\d+$")
    ]  # endpoint of the edge's router: "tls/edge.local:7448"


class UplinkNode(Node):
    """Forwards encoded messages between two Zenoh sessions; the node has no inputs and outputs of its own."""

    name = "uplink"
    Config = UplinkConfig
    config: UplinkConfig

    def configure(self) -> None:
        self._sessions: list[zenoh.Session] = []
        self._bridge: Bridge | None = None
        self._cut_since_s: float | None = None
        self._cuts = 0
        self._bulk_session_cut = False
        self._attempts, self._next_attempt_s = 0, 0.0
        self._fault: UserError | None = None  # of the last attempt

    def source(self) -> Iterator[SourceItem | None]:
        """Run until all topics that the robot has published on have ended (live sensors never end)."""
        if self.live_settings is None:
            raise UserError("the uplink runs live only: remove it from lockstep runs")
        started = time.monotonic()
        while self._bridge is None:
            if self._may_attempt():
                try:
                    self._connect()
                    self._attempts = 0
                    break
                except UserError as error:
                    self._fault = error
            self.figures.set("link_up", 0)
            self.detail = f"no link for {time.monotonic() - started:.0f} s: {self._fault}"
            yield None
            time.sleep(_POLL_S)
        while not self._all_topics_ended():
            self._update_detail()
            self._replace_bulk_session()
            yield None
            time.sleep(_POLL_S)

    def _may_attempt(self) -> bool:
        """Return whether the pause after the last attempt to connect is over; if so, begin an attempt."""
        now = time.monotonic()
        if now < self._next_attempt_s:
            return False
        pause_s = _BACK_OFF_S[min(self._attempts, len(_BACK_OFF_S) - 1)]
        self._attempts, self._next_attempt_s = self._attempts + 1, now + pause_s
        return True

    def close(self) -> None:
        """Close all sessions in threads, waiting at most `_CLOSE_S`: closing may block without a link."""
        threads = [threading.Thread(target=s.close, daemon=True) for s in self._sessions]
        for thread in threads:
            thread.start()
        deadline = time.monotonic() + _CLOSE_S
        for thread in threads:
            thread.join(max(deadline - time.monotonic(), 0.0))

    def _connect(self) -> None:
        """Open all sessions; if one cannot be opened, close the others.

        Raises:
            UserError: no router answers on one of the two sides.
        """
        live = self._live_settings()
        opened: list[zenoh.Session] = []
        try:
            for buffer_bytes in (URGENT_BUFFER_BYTES, BULK_BUFFER_BYTES):
                opened.append(self._open_edge_session(buffer_bytes))
            login = login_of(live.security, self.name)
            opened.append(open_session(live.endpoints, _ATTEMPT_S, login=login))
        except UserError:
            for session in opened:
                session.close()
            raise
        self._sessions = opened
        small, large, robot = opened
        self._bridge = Bridge(live.robot, BridgeSessions(robot=robot, edge=small, edge_bulk=large))

    @property
    def _connected(self) -> Bridge:
        assert self._bridge is not None  # set by `_connect`
        return self._bridge

    def _live_settings(self) -> LiveSettings:
        assert self.live_settings is not None  # the uplink runs live only
        return self.live_settings

    def _open_edge_session(self, buffer_bytes: int) -> zenoh.Session:
        return open_link(self.config.edge, _ATTEMPT_S, self._live_settings().security, buffer_bytes)

    def _replace_bulk_session(self) -> None:
        """Replace the session for large messages, after an interruption, when the small one is connected."""
        if not self._bulk_session_cut or not self._sessions[0].info.routers_zid() or not self._may_attempt():
            return
        try:
            large = self._open_edge_session(BULK_BUFFER_BYTES)
        except UserError:
            return
        small, old, robot = self._sessions
        self._sessions = [small, large, robot]
        self._bulk_session_cut = False
        self._attempts = 0
        self._connected.replace_bulk_session(BridgeSessions(robot=robot, edge=small, edge_bulk=large))
        threading.Thread(target=old.close, daemon=True).start()

    def _all_topics_ended(self) -> bool:
        """Return whether all topics on which the robot published have ended."""
        spoke = {name for name, traffic in self._connected.forwarded_up().items() if traffic.messages}
        return bool(spoke) and spoke <= self._connected.ended

    def _update_detail(self) -> None:
        now = time.monotonic()
        if all(session.info.routers_zid() for session in self._sessions[:2]):
            self._cut_since_s = None
            state = "connected"
        else:
            if self._cut_since_s is None:
                self._cut_since_s, self._cuts = now, self._cuts + 1
            self._bulk_session_cut = True
            state = f"no link for {now - self._cut_since_s:.0f} s"
        up = self._connected.forwarded_up().values()
        self.figures.set("link_up", self._cut_since_s is None)
        self.figures.set("link_cuts_total", self._cuts)
        self.figures.set("link_sent_messages_total", sum(c.messages for c in up))
        self.figures.set("link_sent_bytes_total", sum(c.bytes for c in up))
        cuts = f", {self._cuts} cuts, {self._connected.interrupted} messages cut off" if self._cuts else ""
        cuts += (
            f", {self._connected.health_dropped} health reports rejected"
            if self._connected.health_dropped
            else ""
        )
        self.rejections.set("health reports that were not forwarded", self._connected.health_dropped)
        self.rejections.set("messages without a valid header, not forwarded", self._connected.undecodable)
        if self._connected.undecodable:
            cuts += f", {self._connected.undecodable} messages without a valid header not forwarded"
        self.detail = (
            f"{state} ({self.config.edge}){cuts}: {sum(c.messages for c in up)} messages, "
            f"{sum(c.bytes for c in up) / 1e6:.1f} MB"
        )
