"""Run a whole deployment in lockstep, and record and hash all its messages."""

from __future__ import annotations

import hashlib
import json
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from beamsplat.common.config.deployment import Deployment
from beamsplat.common.files.persist import make_folder, write_atomically
from beamsplat.common.messages.codec import encode, schema_of
from beamsplat.common.recording import RecordingWriter
from beamsplat.common.runtime.lockstep import Lockstep
from beamsplat.common.runtime.mailbox import Envelope
from beamsplat.common.runtime.registry import Service
from beamsplat.services.nodes import NODES
from beamsplat.tools.system.assembly import build_node
from beamsplat.tools.system.run_summary import RunSummary

# Not part of a lockstep run: it records by itself and has no viewers.
OUTSIDE = ("monitor", "page", "recorder")


class MessageHash:
    """SHA-256 over topic, schema, sequence number and payload of all messages in order; count by topic."""

    def __init__(self) -> None:
        self._all = hashlib.sha256()
        self.counts: dict[str, int] = {}

    def add(self, envelope: Envelope, payload: bytes) -> None:
        """Add one message to the hash and to the count of its topic; `payload` is the encoded message."""
        head = f"{envelope.topic} {schema_of(envelope.message)} {envelope.header.sequence} {len(payload)}\n"
        self._all.update(head.encode())
        self._all.update(payload)
        self.counts[envelope.topic] = self.counts.get(envelope.topic, 0) + 1

    def hexdigest(self) -> str:
        """Return the SHA-256 over all messages added so far as 64 hex digits."""
        return self._all.hexdigest()


def run_offline(
    deployment: Deployment, out: Path, console: Console, table: dict[str, Service] = NODES
) -> dict[str, Any]:
    """Run all nodes of a deployment in lockstep, and return the contents of summary.json.

    Writes `messages` (a recording of all messages) and summary.json (hash, counts, wall time) into `out`. The
    deployment must not contain the nodes named in `OUTSIDE`.

    Raises:
        UserError: an option is invalid, or the data cannot be played.
    """
    nodes = [build_node(deployment, name, table) for name in deployment.nodes]
    digest = MessageHash()
    started = time.perf_counter()
    make_folder(out)
    progress = Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        console=console, transient=True,
    )  # fmt: skip
    with RecordingWriter(out / "messages", overwrite=True) as writer, progress:
        total = next((n.expected_messages() for n in nodes if hasattr(n, "expected_messages")), None)
        task = progress.add_task("lockstep", total=total)

        def on_message(envelope: Envelope) -> None:
            digest.add(envelope, encode(envelope.message))
            writer.write(envelope.topic, envelope.message, envelope.header.publish_ns, envelope.header)
            if envelope.header.producer == "replay":
                progress.advance(task)

        mailboxes = Lockstep(nodes, on_message).run()
    end = RunSummary.of_lockstep(nodes, mailboxes, digest.counts)
    summary = {
        "sha256": digest.hexdigest(),
        "messages": sum(digest.counts.values()),
        "topics": digest.counts,
        "dropped": {
            node: {name: count.dropped for name, count in mailbox.counts.items() if count.dropped}
            for node, mailbox in mailboxes.items()
        },
        "refused": end.losses,
        "missing": list(end.missing),
        "wall_s": time.perf_counter() - started,
    }
    write_atomically(out / "summary.json", json.dumps(summary, indent=1).encode())
    return summary
