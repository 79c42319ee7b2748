"""Settings of one node process of a live system."""

from __future__ import annotations

import secrets
from dataclasses import dataclass, field
from pathlib import Path

from beamsplat.common.security.keys import NO_SECURITY, SecurityConfig


@dataclass(frozen=True)
class LiveSettings:
    """Connection, pacing and hand-over settings of a node process; the node's options are in its config."""

    robot: str
    endpoints: tuple[str, ...]
    run_dir: Path
    security: SecurityConfig = NO_SECURITY  # keys for links to other hosts
    rate: float = 1.0  # pacing of recorded sources: times real time, 0 = as fast as possible
    wait_for: frozenset[str] = frozenset()  # a source starts when these nodes are active
    wait_s: float = 60.0  # but after this time it starts without them
    without_producer: frozenset[str] = (
        frozenset()
    )  # inputs that no node of the deployment produces: not waited for
    resume: bool = False  # a restarted source continues where the crashed process stopped
    exit_when_drained: bool = False  # else the process answers queries until it is stopped
    # Identity of this process, claimed by the supervisor (common/messages/instances.py).
    epoch: int = 1
    instance: str = field(default_factory=lambda: secrets.token_hex(8))  # 16 hex digits
    nodes_in_process: int = 1  # each reports an equal part of the memory and CPU time of the process
    standby: bool = False  # start as the successor in a hand-over: see runtime/handover.py
