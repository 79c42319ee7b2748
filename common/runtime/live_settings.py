"""How a process takes part in the live system."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from beamsplat.common.security.keys import OPEN, SecurityConfig


@dataclass(frozen=True)
class LiveSettings:
    """How a process takes part; everything about the node itself is in the node's own config."""

    robot: str
    endpoints: tuple[str, ...]
    run_dir: Path
    security: SecurityConfig = OPEN  # of links to other hosts
    rate: float = 1.0  # pacing of recorded sources: times real time, 0 = as fast as possible
    wait_for: frozenset[str] = frozenset()  # a source starts when these nodes are active
    wait_s: float = 60.0
    without_producer: frozenset[str] = (
        frozenset()
    )  # inputs that nobody in this deployment produces: not waited for
    resume: bool = False  # a restarted source goes on where its predecessor died
    exit_when_drained: bool = False
    instance: str = ""  # 16 hex digits that the supervisor knows it by; "" = random
    standby: bool = False  # says nothing until the supervisor has its predecessor retire
