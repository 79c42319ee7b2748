"""The plan of optimisation steps: fewer at once the later a keyframe is, the others owed, none lost in silence."""

import pytest

from beamsplat.services.mapping.mapper import FULL, HALF
from beamsplat.services.mapping.step_plan import StepPlan


@pytest.mark.parametrize(
    ("delay_s", "expected"),
    [(-0.5, (16, 4)), (0.0, (16, 4)), (0.5, (8, 2)), (0.9, (2, 1)), (1.0, (2, 0)), (60.0, (2, 0))],
)
def test_the_nearer_to_the_target_the_fewer_steps_at_once(delay_s, expected):
    assert StepPlan.at_once(delay_s, 1.0, 16, 4) == expected


def test_a_longer_target_allows_more_steps():
    assert StepPlan.at_once(1.0, 4.0, 16, 4) == (12, 3)


def taken(plan):
    pieces = []
    while (piece := plan.take(HALF)) is not None:
        pieces.append((piece.kind, piece.size, piece.count))
    return pieces


def test_owed_steps_are_taken_in_small_pieces_in_the_order_in_which_they_fell_due():
    plan = StepPlan()
    plan.owe("window", HALF, 10)
    plan.owe("window", FULL, 4)
    plan.owe("refine", HALF, 9, first=True)
    plan.owe("window", HALF, 0)
    assert plan.count == 23
    assert taken(plan) == [
        ("refine", HALF, 8), ("refine", HALF, 1), ("window", HALF, 8), ("window", HALF, 2), ("window", FULL, 3),
        ("window", FULL, 1),
    ]  # fmt: skip
    assert plan.count == 0


def test_anchors_that_move_again_before_the_gaps_are_closed_cost_no_further_steps():
    plan = StepPlan()
    plan.owe("window", HALF, 4)
    plan.mend(HALF, 30)
    plan.take(HALF)
    plan.mend(HALF, 30)
    assert plan.count == 34
    assert [piece[0] for piece in taken(plan)] == ["refine"] * 4 + ["window"]


def test_the_number_of_owed_steps_is_bounded_and_the_others_are_counted():
    plan = StepPlan()
    for _ in range(2000):
        plan.owe("window", HALF, 18)
        plan.owe("window", FULL, 5)
    assert plan.count == 20_000
    assert plan.dropped == 2000 * 23 - 20_000
    assert sum(count for _, _, count in taken(plan)) == 20_000


def test_a_plan_continues_where_another_one_stopped():
    plan, other = StepPlan(), StepPlan()
    plan.owe("window", HALF, 18)
    plan.owe("refine", FULL, 6)
    plan.take(HALF)
    other.owe("window", FULL, 3)  # is replaced
    other.resume(plan.progress())
    assert other.count == plan.count == 16
    assert taken(other) == taken(plan)
