"""Results of background jobs are delivered at points that depend on messages, not on speed."""

import threading

import pytest

from beamsplat.common.runtime.jobs import JobAbandoned, JobQueue, JobThreads, LazyFuture
from beamsplat.common.runtime.node import Job
from tests.common.polling import wait_until


@pytest.fixture(params=["lazy", "thread"])
def jobs(request):
    return JobQueue(LazyFuture if request.param == "lazy" else JobThreads(lambda: False).submit)


def test_a_result_is_due_before_the_nth_message_in_both_runners(jobs):
    jobs.start(Job("sum", lambda: 42, after=2))
    assert list(jobs.before_message("lidar/scan")) == []
    assert list(jobs.before_message("rig")) == [("sum", 42)]
    assert list(jobs.before_message("rig")) == []


def test_only_messages_on_the_topic_of_the_job_count(jobs):
    jobs.start(Job("sum", lambda: 42, after=1, of="lidar/scan"))
    assert list(jobs.before_message("rig")) == []
    assert list(jobs.before_message("lidar/scan")) == [("sum", 42)]


def test_at_the_end_all_results_are_delivered_also_of_jobs_that_results_start(jobs):
    jobs.start(Job("first", lambda: 1))
    results = []
    for name, result in jobs.remaining_results():
        results.append((name, result))
        if name == "first":
            jobs.start(Job("second", lambda: 2, after=100))
    assert results == [("first", 1), ("second", 2)]


def test_a_result_by_its_future_is_delivered_once(jobs):
    future = jobs.start(Job("one", lambda: 1))
    assert list(jobs.result_of(future)) == [("one", 1)]
    assert list(jobs.result_of(future)) == []
    assert list(jobs.remaining_results()) == []


def test_an_error_of_a_job_is_raised_where_its_result_is_delivered(jobs):
    jobs.start(Job("fails", lambda: 1 / 0, after=1))
    with pytest.raises(ZeroDivisionError):
        list(jobs.before_message("rig"))


def test_jobs_without_a_fixed_delivery_run_in_order_and_are_delivered_when_finished():
    go = threading.Event()
    jobs = JobQueue(JobThreads(lambda: False).submit)
    first = jobs.start(Job("first", lambda: go.wait(10.0)))
    second = jobs.start(Job("second", lambda: 2))
    assert list(jobs.finished()) == []
    assert not second.done()
    go.set()
    wait_until(lambda: first.done() and second.done())
    assert list(jobs.finished()) == [("first", True), ("second", 2)]


def test_a_result_that_a_step_waits_for_does_not_wait_for_other_jobs():
    go = threading.Event()
    jobs = JobQueue(JobThreads(lambda: False).submit)
    jobs.start(Job("writes to a slow disk", go.wait))
    jobs.start(Job("sum", lambda: 42, after=1))
    assert list(jobs.before_message("rig")) == [("sum", 42)]
    go.set()
    assert list(jobs.remaining_results()) == [("writes to a slow disk", True)]


def test_a_process_that_must_stop_abandons_a_job_that_does_not_finish():
    never, stop = threading.Event(), []
    jobs = JobQueue(JobThreads(lambda: bool(stop)).submit)
    jobs.start(Job("endless", never.wait, after=1))
    stop.append(True)
    with pytest.raises(JobAbandoned):
        list(jobs.before_message("rig"))
    never.set()
