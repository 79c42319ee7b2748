"""A mapper that is behind: keyframes are inserted first, the steps of all of them are made up later."""

import itertools

from beamsplat.common.messages import Tick
from beamsplat.common.messages.header import Header
from beamsplat.common.runtime.lockstep import Lockstep
from beamsplat.services.keyframes.node import KeyframesConfig, KeyframesNode
from beamsplat.services.mapping.mapper import HALF
from beamsplat.services.mapping.node import MappingConfig, MappingNode
from tests.services.mapping import room_drive as r
from tests.services.mapping.session.maps import handle, make_node, message

STEPS = {"half_steps": 8, "full_steps": 4, "tick_steps": 0}


def drive(**options):
    """Return the mapper, and (time in s, message) by topic, of a drive with a keyframe each half second."""
    node, heard = MappingNode(MappingConfig(**STEPS, **options)), {}

    def on_message(envelope):
        heard.setdefault(envelope.topic, []).append((envelope.header.publish_ns * 1e-9, envelope.message))

    Lockstep(
        [r.RoomDrive(r.DriveConfig(pictures=24)), r.Localizer(r.LocalizerConfig()), r.Fusion(r.Fusion.Config()),
         KeyframesNode(KeyframesConfig(distance_m=0.15)), node],
        on_message,
    ).run()  # fmt: skip
    return node, heard


def delays_s(heard):
    """Return the time from each keyframe's publication to its acknowledgement."""
    sent = {m.id: at for at, m in reversed(heard["keyframes/frame"])}
    return [at - sent[m.id] for at, m in heard["keyframes/ack"]]


def test_a_slow_mapper_acknowledges_each_keyframe_within_the_target_and_owes_no_steps_in_the_end():
    """0.3 s for an insertion with its first steps, 0.3 s for each piece of owed steps."""
    node, heard = drive(step_cost_s=0.3, idle_cost_s=0.3)
    count = len({m.id for _, m in heard["keyframes/frame"]})
    assert count >= 10
    assert len(delays_s(heard)) == count
    assert max(delays_s(heard)) < 1.0
    assert node._mapper.steps == 12 * count
    assert node._mapper.plan.count == node._mapper.plan.dropped == 0
    during = [m.steps for _, m in heard["mapping/status"]]
    assert during[-1] < 12 * count  # some were made up after the drive


def test_a_mapper_that_cannot_keep_up_inserts_every_keyframe_with_few_steps():
    """0.8 s a keyframe, one each half second: the delay grows, and no idle time is left during the drive."""
    node, heard = drive(step_cost_s=0.8, idle_cost_s=0.3)
    statuses = [m for _, m in heard["mapping/status"]]
    steps = [b.steps - a.steps for a, b in itertools.pairwise(statuses)]
    assert (
        steps[4:9] == [1] * 5
    )  # of 12: an eighth of the half-size ones; the time of the last ones stands still
    assert len(delays_s(heard)) == len({m.id for _, m in heard["keyframes/frame"]})
    assert node._mapper.steps == 12 * len(statuses)


def test_a_mapper_without_delay_has_done_all_steps_before_the_next_keyframe():
    node, heard = drive()
    statuses = [m for _, m in heard["mapping/status"]]
    assert statuses[-1].steps >= 12 * (len(statuses) - 1)
    assert node._mapper.steps == 12 * len(statuses)


def test_a_tick_plans_steps_only_if_none_are_owed():
    node = make_node(tick_steps=5)
    handle(node, "keyframes/frame", message(0))
    before = node._mapper.steps
    for count in range(3):
        handle(node, "tick", Tick(stamp_ns=r.T0 + count, count=count))
    assert (node._mapper.steps, node._mapper.plan.count) == (before, 5)
    while node.has_idle_work():
        assert list(node.handle_idle()) == []
    assert (node._mapper.steps, node._mapper.plan.count) == (before + 5, 0)


def test_a_keyframe_that_arrives_interrupts_owed_steps_which_stay_owed():
    node = make_node()
    handle(node, "keyframes/frame", message(0))
    before, drawn = node._mapper.steps, node._mapper.engine.optimise
    node._mapper.plan.owe("window", HALF, 8)

    def optimise(steps, T_map_anchor, settings, must_stop):
        def after_three():
            if node._mapper.steps - before == 2:
                list(node.handle_arrival("keyframes/frame", message(1)))
            return must_stop()

        return drawn(steps, T_map_anchor, settings, after_three)

    node._mapper.engine.optimise = optimise
    list(node.handle_idle())
    assert 2 <= node._mapper.steps - before <= 4
    assert node._mapper.plan.count == 8 - (node._mapper.steps - before)
    node._mapper.engine.optimise = drawn
    while node.has_idle_work():
        list(node.handle_idle())
    assert node._mapper.steps == before + 8


def test_owed_steps_survive_the_process(tmp_path):
    node = make_node(tmp_path / "s")
    handle(node, "keyframes/frame", message(0))
    node._mapper.plan.owe("window", HALF, 9)
    node.hand_over()
    again = make_node(tmp_path / "s")
    assert again._mapper.plan.count == 9
    assert again.has_idle_work()
    again.close()


def test_the_status_says_how_many_keyframes_wait_on_the_robot():
    node = make_node()
    frame = message(0)
    node.on_header(Header(frame.stamp_ns, 0, 0, 0, 1, "keyframes", "ab" * 8, 7))
    handle(node, "keyframes/frame", frame)
    assert node.detail.startswith("1 keyframes, 7 wait on the robot, ")


def test_the_newest_keyframe_is_shown_however_late_it_is():
    """Depth and link may need longer than the target; a keyframe behind which another waits is not shown."""
    node = make_node()
    list(node.handle_arrival("tick", Tick(stamp_ns=r.T0 + 10_000_000_000, count=0)))
    for waiting, shown in ((None, 0), (2, None), (None, 2)):
        if waiting is not None:
            list(node.handle_arrival("keyframes/frame", message(waiting)))
        number = 1 if shown is None else shown
        previews = handle(node, "keyframes/frame", message(number)).get("mapping/preview", [])
        assert [m.stamp_ns for m in previews] == ([] if shown is None else [message(shown).stamp_ns])
