"""Sentences about the damaged parts of recordings."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path


def describe_damage(path: Path, spans_ns: Collection[tuple[int, int]], start_ns: int, end_ns: int) -> str:
    """Return one sentence about damaged chunks that were left out, or "".

    Args:
        path: the recording.
        spans_ns: first and last time of each damaged chunk; (0, 0) = unknown.
        start_ns, end_ns: first and last time of the recording.
    """
    if not spans_ns:
        return ""
    known = sorted((first, last) for first, last in spans_ns if start_ns <= first <= last <= end_ns)
    lost_ns, reach_ns = 0, start_ns
    for first, last in known:
        lost_ns += max(0, last - max(first, reach_ns))
        reach_ns = max(reach_ns, last)
    chunks = f"{len(spans_ns)} damaged chunk{'s were' if len(spans_ns) > 1 else ' was'} left out"
    if not known:
        return f"{path}: {chunks}; copy it again from where it was recorded"
    after_s = ((known[0][0] - start_ns) / 1e9, (max(last for _, last in known) - start_ns) / 1e9)
    return (
        f"{path}: {chunks}: {lost_ns / 1e9:.1f} s of {(end_ns - start_ns) / 1e9:.1f} s are lost, between "
        f"{after_s[0]:.1f} and {after_s[1]:.1f} s after the start; copy it again from where it was recorded"
    )
