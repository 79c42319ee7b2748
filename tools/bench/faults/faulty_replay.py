"""A replay whose sensors fail as the control file of `injection` says."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.common.messages import Message
from beamsplat.common.runtime.node import SourceItem
from beamsplat.services.replay.node import ReplayNode
from beamsplat.tools.bench.faults.injection import VARIABLE, InjectedState

_HOUR_NS = 3600 * 10**9
_MAX_NS = 2**63 - 1
Change = Callable[[Message], dict[str, Any]]  # fields of a message that the fault replaces


def _nan(message: Message) -> dict[str, Any]:
    """Replace all measured values by NaN, those of an image by zeros."""
    return _filled(message, np.nan)


def _huge(message: Message) -> dict[str, Any]:
    """Replace all measured values by the largest ones of their types."""
    return _filled(message, np.inf if hasattr(message, "ranges_m") else 1e300)


def _filled(message: Message, value: float) -> dict[str, Any]:
    fields = {}
    for name in ("ranges_m", "intensities", "T_odom_body", "velocity_m_s", "angular_velocity_rad_s",
                 "T_map_body", "data"):  # fmt: skip
        array = getattr(message, name, None)
        if isinstance(array, np.ndarray):
            plain = array.dtype.kind == "f"
            fields[name] = np.full_like(array, value if plain else (0 if np.isnan(value) else 255))
    return fields


def _noise(message: Message) -> dict[str, Any]:
    """Replace all measured values by random bytes."""
    rng = np.random.default_rng(message.stamp_ns)
    fields = _filled(message, 0.0)
    return {name: np.frombuffer(rng.bytes(a.nbytes), a.dtype).reshape(a.shape) for name, a in fields.items()}


def _empty(message: Message) -> dict[str, Any]:
    """Remove all measured values of scans and images."""
    return {name: array[:0] for name, array in _filled(message, 0.0).items() if array.ndim == 1}


def _shifted(offset_ns: int) -> Change:
    return lambda message: {"stamp_ns": min(max(message.stamp_ns + offset_ns, 0), _MAX_NS)}


SENSOR_FAULTS: dict[str, Change] = {
    "NaN": _nan, "huge values": _huge, "noise": _noise, "empty": _empty,
    "stamps +1 h": _shifted(_HOUR_NS), "stamps -1 h": _shifted(-_HOUR_NS),
    "stamps 0": _shifted(-_MAX_NS), "stamps 2^63-1": _shifted(_MAX_NS),
}  # fmt: skip


class FaultyReplay(ReplayNode):
    """A replay of recorded data that changes the messages of the sensors while a fault is active."""

    name = "replay"

    def source(self) -> Iterator[SourceItem]:
        """Yield the messages of the recording; while a fault is active, those of sensors are changed."""
        state = InjectedState(Path(os.environ[VARIABLE]))
        for item in super().source():
            fault = state.get("sensors")
            if fault and item.topic not in ("rig", "tick"):
                yield item._replace(
                    message=item.message.model_copy(update=SENSOR_FAULTS[fault](item.message))
                )
            else:
                yield item
