"""Results come out in the order in which their work was begun, as far as the limit allows."""

import numpy as np

from beamsplat.services.fusion.ordered_results import OrderedResults


def test_any_order_of_finishing_gives_the_order_of_beginning():
    rng = np.random.default_rng(3)
    for _ in range(20):
        results = OrderedResults(most=100)
        numbers = [results.begin() for _ in range(30)]
        out = []
        for number in rng.permutation(numbers):
            out += results.finish(int(number), f"result {number}")
        assert out == [f"result {number}" for number in numbers]


def test_work_that_never_ends_delays_a_limited_number_of_results():
    results = OrderedResults(most=3)
    endless = results.begin()
    out = []
    for _ in range(6):
        number = results.begin()
        out.append(results.finish(number, number))
    assert out == [[], [], [], [2], [3], [4]]
    assert results.finish(endless, 1) == [1, 5, 6, 7]
