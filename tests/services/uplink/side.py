"""One host of a pair, in a process of its own: its supervisor, and a log of when which message was heard.

    python -m tests.services.uplink.side DEPLOYMENT.json HEARD.jsonl

Commands, a line each on standard input: "kill NODE" (-9), "wait NODE" (restarted and active), "state", "end".
Each is answered by one line of JSON on standard output.
"""

from __future__ import annotations

import json
import os
import select
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path

from beamsplat.common.config.deployment import Deployment
from beamsplat.common.messages.header import DecodeError, Header
from beamsplat.common.topics import topic
from beamsplat.common.zenoh.bus import key, open_session
from beamsplat.common.zenoh.streams import declare_subscription, decode_sample
from beamsplat.tools.system.health_table import HealthTable
from beamsplat.tools.system.supervisor import Supervisor

HEARD = {
    "robot": ("lidar/scan", "localization/odometry", "keyframes/frame", "keyframes/ack"),
    "edge": ("localization/odometry", "keyframes/frame", "keyframes/ack", "mapping/status", "mapping/poses"),
}  # fmt: skip
_POLL_S = 0.1


class MessageLog:
    """Writes a line for each received message: topic, time (monotonic ns), and fields of its header."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", buffering=1 << 16)

    def listen(self, session, robot: str, name: str):
        """Log the messages of a topic from now on; keep the returned subscriber."""
        row = topic(name)

        def take(sample) -> None:
            now_ns = time.monotonic_ns()
            with suppress(DecodeError):
                header = Header.unpack(sample.attachment.to_bytes())
                line = {
                    "topic": name, "heard_ns": now_ns, "sent_ns": header.publish_ns, "stamp_ns": header.stamp_ns,
                    "instance": header.instance, "bytes": len(sample.payload),
                }  # fmt: skip
                if name == "keyframes/ack":
                    line["status"] = decode_sample(sample, row).message.status
                if name == "mapping/poses":
                    line["ids"] = decode_sample(sample, row).message.keyframe_ids.tolist()
                self._file.write(json.dumps(line) + "\n")

        return declare_subscription(session, key(robot, name), row, "every", take)

    def flush(self) -> None:
        self._file.flush()


class HostCommands:
    """Executes commands on one supervisor."""

    def __init__(self, supervisor: Supervisor, board: HealthTable) -> None:
        self._supervisor, self._board = supervisor, board

    def answer(self, verb: str, name: str) -> dict:
        if verb == "kill":
            child = self._supervisor.children[name]
            alive = child.process.is_alive()
            if alive:
                os.kill(child.process.pid, signal.SIGKILL)
            return {"killed": alive}
        children = self._supervisor.children.values()
        records = self._board.records
        return {
            "states": self._board.states(),
            "details": {n: r.health.detail for n, r in records.items()},
            "seen_ns": {n: r.health.stamp_ns for n, r in records.items()},
            "losses": {
                n: {i.topic: [i.lost, i.dropped, i.undecodable, i.stale] for i in r.health.inputs}
                for n, r in records.items()
            },
            "restarts": {c.name: c.restarts for c in children},
            "down": [c.name for c in children if not c.process.is_alive()],
            "failed": [c.name for c in children if c.failed],
        }


def main() -> None:
    deployment = Deployment.model_validate_json(Path(sys.argv[1]).read_text())
    log = MessageLog(Path(sys.argv[2]))
    with Supervisor(deployment) as supervisor, open_session(deployment.router.listen[:1]) as session:
        board = HealthTable(session, deployment.robot)
        side = HostCommands(supervisor, board)
        kept = [log.listen(session, deployment.robot, name) for name in HEARD[deployment.role]]
        print(json.dumps({"listens": len(kept)}), flush=True)
        while True:
            supervisor.poll()
            if not select.select([sys.stdin], [], [], _POLL_S)[0]:
                continue
            verb, _, name = sys.stdin.readline().strip().partition(" ")
            if verb in ("", "end"):
                break
            log.flush()
            print(json.dumps(side.answer(verb, name)), flush=True)
    log.flush()
    print(json.dumps({}), flush=True)


if __name__ == "__main__":
    main()
