"""A client that holds a robot's valid certificate and means harm: `python -m tests.tools.system.hostile ...`."""

import argparse
import json
import sys
import time
from pathlib import Path

import zenoh

from beamsplat.common.security.keys import HostKeys, SecurityConfig

ALLOWED = ("keyframes/frame", "localization/odometry", "localization/anchors", "health/localization")
PATIENCE_US = 120_000_000


def open_hostile(endpoint, keys):
    """A session without our own bounds: it waits until even the largest message is through."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("scouting/multicast/enabled", "false")
    connect = {"endpoints": [endpoint], "timeout_ms": 3000, "exit_on_failure": True}
    config.insert_json5("connect", json.dumps(connect))
    config.insert_json5(
        "transport/link/tx/queue/congestion_control/block/wait_before_close", str(PATIENCE_US)
    )
    HostKeys.of(SecurityConfig(keys=keys)).identify(config)
    return zenoh.open(config)


def flood(session, robot, rate, seconds, attachment):
    """Garbage on all keys that the robot may write; tells how much."""
    keys = [f"beamsplat/{robot}/{name}" for name in ALLOWED]
    garbage, sent, started = bytes(range(256)) * 2, 0, time.monotonic()
    while (passed := time.monotonic() - started) < seconds:
        while sent < rate * passed:
            session.put(keys[sent % len(keys)], garbage, attachment=attachment, encoding="application/cbor;X")
            sent += 1
        time.sleep(0.001)
    return sent


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("endpoint")
    parser.add_argument("keys", type=Path)
    parser.add_argument("--robot", default="r1")
    parser.add_argument("--rate", type=float, default=10_000.0)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--megabytes", type=float, default=0.0, help="one message of so many instead")
    parser.add_argument("--header", default="", help="hex of a header that was heard")
    a = parser.parse_args()
    with open_hostile(a.endpoint, a.keys) as session:
        if a.megabytes:
            block = zenoh.CongestionControl.BLOCK
            key = f"beamsplat/{a.robot}/keyframes/frame"
            session.put(key, bytes(int(a.megabytes * 1e6)), congestion_control=block)
            time.sleep(2.0)
            print(1)
            return
        print(flood(session, a.robot, a.rate, a.seconds, bytes.fromhex(a.header) or None))
    sys.stdout.flush()


if __name__ == "__main__":
    main()
