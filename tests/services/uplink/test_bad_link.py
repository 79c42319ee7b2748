"""The real system over a bad link: 20 Mbit/s, 20 ms each way, 1 % loss; and cut for a while.

Figures are printed (`pytest -s`), not asserted: they belong to a machine. What is lost is asserted.
"""

import math
import time

import pytest

from tests.services.uplink.pair import RATE, BadLinkPair, onboard, quantiles, transit
from tests.services.uplink.radio import Radio

BAD = {"rate_mbit": 20, "delay_ms": 20.0, "loss": 0.01, "seed": 7}
SETTLED_S = 30.0  # link up, before it is cut
LAP_S = 70.0


def print_line(what, values):
    print(f"  {what:<58} {values}", flush=True)


def milliseconds(latencies):
    return "p50 {:.0f}, p95 {:.0f}, p99 {:.0f}, most {:.0f} ms".format(*quantiles(latencies))


def print_onboard(log, phase, since_ns, until_ns):
    share, rate, late = onboard(log, since_ns, until_ns)
    print_line(
        f"localization onboard, {phase}", f"{100 * share:.1f} % of scans, {rate:.2f} Hz, {milliseconds(late)}"
    )


def print_transit(near, far, since_ns, until_ns):
    for topic in ("localization/odometry", "keyframes/frame"):
        late, missing = transit(near, far, topic, since_ns, until_ns)
        print_line(f"{topic} to the edge", f"{len(late)}: {milliseconds(late)}; {missing} not yet there")


def run_with_cut(pair, radio, cut_s):
    """Run and cut the link; return (begin, cut, mended), monotonic ns."""
    pair.wait(lambda near, far: len(pair.far.log.of("keyframes/frame")) >= 2, 120)
    begin_ns = time.monotonic_ns()
    time.sleep(SETTLED_S)
    if cut_s:
        print(radio.tell("cut"))
    cut_ns = time.monotonic_ns()
    time.sleep(cut_s)
    print(radio.tell("mend"))
    return begin_ns, cut_ns, time.monotonic_ns()


def print_recovery(pair, cut_ns, mended_ns):
    outage_s = (mended_ns - cut_ns) / 1e9
    made = pair.near.log.first("keyframes/frame", "sent_ns")
    durable = pair.far.log.first("keyframes/ack", "sent_ns")  # said once it is on the disk
    mapped = pair.far.log.first("mapping/status", "sent_ns")
    during = [i for i, t in made.items() if cut_ns - 1_000_000_000 <= t < mended_ns]
    for what, when, bound in (("durable", durable, 1 / 3), ("mapped", mapped, 1.0)):
        last_s = max(((when[i] - mended_ns) / 1e9 for i in during if i in when), default=float("nan"))
        print_line(f"{len(during)} keyframes of an outage of {outage_s:.0f} s {what}",
            f"{last_s:.1f} s after it (bound {bound * outage_s:.0f} s)")  # fmt: skip
    late, _ = transit(pair.near.log, pair.far.log, "keyframes/frame", mended_ns + 1_500_000_000,
                      mended_ns + round(outage_s / 3 * 1e9))  # fmt: skip
    print_line("live keyframes meanwhile", milliseconds(late))


def check_complete(pair):
    """Check that every keyframe of the robot is on the edge's disk and in its map, or was refused with
    a message.
    """
    made = set(pair.near.log.first("keyframes/frame", "sent_ns"))
    refused = {line["stamp_ns"] for line in pair.far.log.of("keyframes/ack") if line["status"] != "ok"}
    print_line("keyframes made, refused", f"{len(made)}, {len(refused)}")
    assert len(made) > 20
    assert set(pair.durable()) == made - refused
    assert set(pair.far.log.of("mapping/poses")[-1]["ids"]) == made - refused
    assert not pair.queued


def print_details(states):
    for state in states:
        for node, detail in sorted(state["details"].items()):
            print_line(node, detail)


@pytest.mark.soak
@pytest.mark.parametrize("cut_s", [0, 60, 600])
def test_a_bad_link_does_not_affect_the_robot_and_loses_no_keyframe(tmp_path, drive, cut_s):
    seconds = RATE * (SETTLED_S + cut_s + 40.0)
    data = drive(math.ceil(seconds / LAP_S))
    with Radio(**BAD) as radio, BadLinkPair(radio, tmp_path, data, duration_s=seconds) as pair:
        begin_ns, cut_ns, mended_ns = run_with_cut(pair, radio, cut_s)
        states = pair.drained(120 + 2 * cut_s)
        near, far = pair.near.log, pair.far.log
        print()
        print_onboard(near, "link up", begin_ns, cut_ns)
        if cut_s:
            print_onboard(near, "link cut", cut_ns, mended_ns)
            print_onboard(near, "catching up", mended_ns, mended_ns + round(cut_s / 3 * 1e9))
        print_transit(near, far, begin_ns, cut_ns - 2_000_000_000)
        if cut_s:
            print_recovery(pair, cut_ns, mended_ns)
        print_details(states)
    check_complete(pair)


@pytest.mark.soak
def test_a_killed_edge_continues_its_session(tmp_path, drive):
    with Radio(**BAD) as radio, BadLinkPair(radio, tmp_path, drive(1), duration_s=LAP_S) as pair:
        pair.wait(lambda near, far: len(pair.durable()) >= 5, 180)  # everything has started
        begin_ns = time.monotonic_ns()
        pair.wait(lambda near, far: len(pair.durable()) >= 15, 180)
        for name in ("mapping", "router"):
            assert pair.far.ask(f"kill {name}")["killed"]
        killed_ns = time.monotonic_ns()
        states = pair.drained(300)
        end_ns = time.monotonic_ns()
        print()
        print_onboard(pair.near.log, "before the edge is killed", begin_ns, killed_ns)
        print_onboard(pair.near.log, "after it", killed_ns, end_ns)
        print_details(states)
        assert set(pair.near.state()["restarts"].values()) == {0}
    check_complete(pair)
