"""Repeated log messages are counted, and logged once per period and subject."""

import pytest

from beamsplat.common.runtime import rate_limited_log
from beamsplat.common.runtime.rate_limited_log import RateLimitedLog


def test_repeated_messages_are_counted_and_logged_once_per_period(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(rate_limited_log.time, "monotonic", lambda: now[0])
    c = RateLimitedLog()
    assert c.due("loss") == 0
    assert [c.due("loss") for _ in range(7)] == [None] * 7
    assert c.due("other") == 0  # each subject separately
    now[0] += rate_limited_log._PERIOD_S
    assert c.due("loss") == 7
    assert c.due("loss") is None
    now[0] += 2 * rate_limited_log._PERIOD_S
    assert c.due("loss") == pytest.approx(1)
