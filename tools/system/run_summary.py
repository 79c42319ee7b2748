"""Summary of a run: what was refused, dropped and lost, by node and reason, and which results are missing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from beamsplat.common.errors import NothingUseful
from beamsplat.common.messages import Health, OutputHealth
from beamsplat.common.runtime.health import NodeRecord, losses_of, results_of
from beamsplat.common.runtime.mailbox import Mailbox
from beamsplat.common.runtime.node import Node

_MOST_LINES = 40
# Result of a run -> (its name, whether it needs images).
_RESULTS = {
    "localization/odometry": ("pose", False),
    "fusion/depth": ("depth", True),
    "keyframes/frame": ("keyframe", True),
}


@dataclass(frozen=True)
class RunSummary:
    """Counts by node and reason, and the results that a run should have had and has not."""

    losses: dict[str, dict[str, int]]
    missing: tuple[str, ...]  # "pose", "depth", "keyframe"

    @staticmethod
    def of_records(records: Mapping[str, NodeRecord], failed: dict[str, str]) -> RunSummary:
        """Return the summary of a live run from the health of its nodes.

        `failed` are the nodes that cannot run, with their reasons.
        """
        losses = {name: dict(record.losses()) for name, record in records.items()}
        for name, why in failed.items():
            losses.setdefault(name, {})[f"cannot run: {why}"] = 1
        results: dict[str, int] = {}
        for record in records.values():
            results.update(record.results())
        return RunSummary(_nonempty(losses), _missing(results))

    @staticmethod
    def of_lockstep(nodes: list[Node], mailboxes: dict[str, Mailbox], sent: dict[str, int]) -> RunSummary:
        """Return the summary of a lockstep run; `sent` are the numbers of messages by topic."""
        losses: dict[str, dict[str, int]] = {}
        results: dict[str, int] = {}
        for node in nodes:
            health = Health(
                stamp_ns=0, node=node.name, instance="", epoch=0, state="drained",
                inputs=mailboxes[node.name].health(), rejected=node.rejections.report(),
                outputs=tuple(OutputHealth(topic=t, sent=sent.get(t, 0), bytes=0) for t in node.outputs),
            )  # fmt: skip
            losses[node.name] = dict(losses_of(health))
            results.update(results_of(health))
        return RunSummary(_nonempty(losses), _missing(results))

    def lines(self) -> list[str]:
        """Return the counts as lines of text, largest first within a node; empty if nothing was lost."""
        rows = [
            (name, count, reason)
            for name, counts in sorted(self.losses.items())
            for reason, count in sorted(counts.items(), key=lambda item: -item[1])
        ]
        if not rows:
            return []
        wide = max(len(name) for name, _, _ in rows)
        shown = [f"  {name:{wide}}  {count:6d}  {reason}" for name, count, reason in rows[:_MOST_LINES]]
        more = len(rows) - len(shown)
        rest = [f"  and {more} more reasons"] if more > 0 else []
        return ["refused, dropped or lost:", *shown, *rest]

    def check_useful(self) -> None:
        """Raise NothingUseful, which names the missing results, if there are any."""
        if self.missing:
            raise NothingUseful(
                f"the run has no {' and no '.join(self.missing)}: the reasons are listed above"
            )


def _nonempty(losses: dict[str, dict[str, int]]) -> dict[str, dict[str, int]]:
    return {name: counts for name, counts in losses.items() if counts}


def _missing(results: dict[str, int]) -> tuple[str, ...]:
    images = results.get("camera/image", 0) > 0
    return tuple(
        name
        for topic, (name, needs_images) in _RESULTS.items()
        if results.get(topic) == 0 and (images or not needs_images)
    )
