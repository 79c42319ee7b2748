"""Several nodes in one process, for robots with little memory (`together` in a deployment)."""

from __future__ import annotations

import os
import signal
import threading
from dataclasses import replace
from pathlib import Path

from beamsplat.common.config.deployment import Deployment
from beamsplat.common.errors import UserError
from beamsplat.common.messages.instances import ProcessId
from beamsplat.common.optional_packages import missing_packages_explained
from beamsplat.common.runtime.live import Live
from beamsplat.common.runtime.registry import Service
from beamsplat.services.nodes import NODES
from beamsplat.tools.system.assembly import Surroundings, build_node
from beamsplat.tools.system.node_process import end_process, limit_threads, live_settings, run_supervised


def serve_together(
    deployment: Deployment,
    around: dict[str, Surroundings],
    identities: dict[str, ProcessId],
    *,
    resume: bool = False,
    table: dict[str, Service] = NODES,
) -> None:
    """Run several nodes in this process, each in its own thread with its own session, until a signal arrives.

    A failure of one node ends all of them.

    Args:
        around: facts about the other nodes, by name of the node that needs them.
        identities: of the nodes on the bus, by name: the nodes to run.
        resume: see `serve`.
        table: known services by name.

    Raises:
        UserError: see `serve`; the text begins with the name of the node.
    """
    threading.excepthook = end_process
    lives: dict[str, Live] = {}
    for name, identity in identities.items():
        settings = replace(
            live_settings(deployment, around[name], identity, resume), nodes_in_process=len(identities)
        )
        lives[name] = Live(build_node(deployment, name, table), settings)
    limit_threads(max(live.running.node.config.threads for live in lives.values()))
    failures: list[UserError] = []

    def stop(*_: object) -> None:
        for live in lives.values():
            live.stop()

    def run(name: str, live: Live) -> None:
        os.nice(live.running.node.config.nice)  # on Linux: of this thread, and of the threads that it starts
        try:
            with missing_packages_explained(name):
                live.run()
        except UserError as error:
            failures.append(UserError(f"{name}: {error}"))
            stop()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    threads = [
        threading.Thread(target=run, args=item, name=f"node-{item[0]}", daemon=True) for item in lives.items()
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        while thread.is_alive():
            thread.join(0.2)
    if failures:
        raise failures[0]


def child_together(
    deployment: Deployment,
    around: dict[str, Surroundings],
    log_file: Path,
    resume: bool,
    table: dict[str, Service],
    identities: dict[str, ProcessId],
) -> None:
    """Run several nodes as one supervised process: see `child` and `serve_together`."""

    def run() -> None:
        serve_together(deployment, around, identities, resume=resume, table=table)

    run_supervised("+".join(identities), log_file, run)
