"""Processes of robot and edge are killed at random over a bad link: nothing blocks, no keyframe is lost."""

import math
import os
import random
import time

import pytest

from tests.services.uplink.pair import RATE, BadLinkPair
from tests.services.uplink.radio import Radio
from tests.services.uplink.test_bad_link import BAD, LAP_S, print_details, print_line

VICTIMS = [
    *(("near", name) for name in ("router", "uplink", "keyframes", "fusion", "depth", "localization", "replay")),
    *(("far", name) for name in ("router", "mapping")),
]  # fmt: skip
QUICK = {"half_steps": 1, "full_steps": 0, "tick_steps": 0}  # how good the map is, others test
KILLS = int(os.environ.get("BEAMSPLAT_KILLS", "100"))
MINUTES = float(os.environ.get("BEAMSPLAT_KILL_MINUTES", "10"))
SEED = int(os.environ.get("BEAMSPLAT_KILL_SEED", "0"))


def kill_at_random(pair, kills, minutes, seed):
    """Kill random processes at random times of a seed; return (time, side, name, killed) of each."""
    chance = random.Random(seed)
    times_s = sorted(chance.uniform(0.0, 60.0 * minutes) for _ in range(kills))
    begin, done = time.monotonic(), []
    for at_s in times_s:
        time.sleep(max(begin + at_s - time.monotonic(), 0.0))
        side, name = chance.choice(VICTIMS)
        killed = getattr(pair, side).ask(f"kill {name}")["killed"]
        done.append((round(at_s, 1), side, name, killed))
    return done


def all_active(near, far):
    """Return whether every process runs and has published its health since."""
    now_ns = time.time_ns()
    for state in (near, far):
        if state["down"] or any(now_ns - t > 3_000_000_000 for n, t in state["seen_ns"].items()):
            return False
    return set(near["states"].values()) | set(far["states"].values()) <= {"active", "drained"}


def drained(near):
    """Return whether the recording has ended and all keyframes are done."""
    return near["states"].get("keyframes") == "drained"


def losses(pair, data_ids):
    """Return keyframes that are neither on the edge's disk, nor refused, nor on the robot's disk."""
    acks = pair.far.log.of("keyframes/ack")
    refused = {line["stamp_ns"] for line in acks if line["status"] != "ok"}
    return data_ids - set(pair.durable()) - refused - pair.queued


@pytest.mark.soak
def test_any_process_may_be_killed_at_any_time(tmp_path, drive):
    """A killed localization starts a new map: queued keyframes of the old one stay on the robot and are
    counted.
    """
    seconds = RATE * (60.0 * MINUTES + 30.0)
    laps = drive(math.ceil(seconds / LAP_S))
    with Radio(**BAD) as radio, BadLinkPair(radio, tmp_path, laps, duration_s=seconds, mapping=QUICK) as pair:
        pair.wait(lambda near, far: len(pair.far.log.of("keyframes/frame")) >= 2, 120)
        done = kill_at_random(pair, KILLS, MINUTES, SEED)
        print(*done, sep="\n")
        states = pair.wait(all_active, 300)
        print()
        print_line("killed", f"{sum(k for *_, k in done)} of {len(done)} in {MINUTES:g} min, seed {SEED}")
        for side in ("near", "far"):
            print_line(f"restarts, {side}", getattr(pair, side).state()["restarts"])
        print_details(states)
        before = set(pair.durable())
        pair.wait(
            lambda near, far: drained(near) or set(pair.durable()) - before, 120
        )  # the chain works from end to end
        states = pair.drained(600)
        print_details(states)
        made = set(pair.near.log.first("keyframes/frame", "sent_ns"))
        earlier = pair.queued
        print_line("keyframes made, on the edge, of earlier drives on the robot",
            f"{len(made)}, {len(pair.durable())}, {len(earlier)}")  # fmt: skip
        assert not any(state["failed"] for state in states)
        assert len(made) > 20
        assert losses(pair, made) == set()
        mapped = set(pair.far.log.of("mapping/poses")[-1]["ids"])
        assert mapped == set(pair.durable())
