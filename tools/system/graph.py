"""Draw the dataflow of a deployment as text and as a Mermaid flowchart."""

from __future__ import annotations

from beamsplat.common.runtime.node import Node, subscriptions
from beamsplat.common.topics import TOPICS

_MARK = {"latest": "newest only", "every": "every one", "latched": "last value"}


def edges(classes: dict[str, type[Node]]) -> list[tuple[str, str, str, str]]:
    """Return (producer, topic, consumer, delivery) of every connection, in the order of `TOPICS`.

    `classes` are the node classes of a deployment by name of the node.
    """
    found: list[tuple[str, str, str, str]] = []
    for topic in TOPICS:
        for producer, node in classes.items():
            if topic not in node.outputs:
                continue
            for consumer, other in classes.items():
                for entry in subscriptions(other):
                    if entry.topic == topic:
                        found.append((producer, topic, consumer, entry.effective_delivery))
    return found


def as_text(classes: dict[str, type[Node]]) -> str:
    """Return the dataflow as text, one line per topic: producer -> topic, message, rate -> consumers."""
    lines = []
    for topic, row in TOPICS.items():
        producers = [name for name, node in classes.items() if topic in node.outputs]
        consumers = [
            f"{name} ({_MARK[entry.effective_delivery]})"
            for name, node in classes.items()
            for entry in subscriptions(node)
            if entry.topic == topic
        ]
        if producers:
            rate = f"{row.rate_hz:g} Hz" if row.rate_hz else "on events"
            lines.append(
                f"{producers[0]:>14} -> {topic:<26} {row.message.__name__:<14} {rate:<10} -> "
                f"{', '.join(consumers) or '(nobody)'}"
            )
    return "\n".join(lines)


def as_mermaid(classes: dict[str, type[Node]]) -> str:
    """Return the dataflow as a Mermaid flowchart: boxes are nodes, arrows are topics.

    On dotted arrows, the consumer receives only the newest message.
    """
    lines = ["flowchart LR"]
    lines += [f"    {name}([{name}])" for name in classes]
    joined: dict[tuple[str, str, bool], list[str]] = {}
    for producer, topic, consumer, delivery in edges(classes):
        joined.setdefault((producer, consumer, delivery == "latest"), []).append(topic)
    for (producer, consumer, newest_only), topics in joined.items():
        arrow = "-.->" if newest_only else "-->"
        lines.append(f"    {producer} {arrow}|{'<br>'.join(topics)}| {consumer}")
    return "\n".join(lines)
