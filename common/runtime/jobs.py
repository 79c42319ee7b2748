"""Background jobs of a node; results are delivered at points that depend on messages, not on speed."""

from __future__ import annotations

import concurrent.futures
import queue
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from beamsplat.common.runtime.node import Job


class JobFuture(Protocol):
    """Interface of a job's future: the two methods of `concurrent.futures.Future` that this module uses."""

    def result(self) -> Any: ...

    def done(self) -> bool: ...


_FutureT = TypeVar("_FutureT", bound=JobFuture)


class LazyFuture:
    """Future that runs its job when the result is requested: single-threaded and reproducible (lockstep)."""

    def __init__(self, job: Job) -> None:
        self._run = job.run

    def result(self) -> Any:
        return self._run()

    def done(self) -> bool:
        return False


class JobAbandoned(Exception):
    """The process must end before the job, for whose result the node waits, has finished."""


class _WorkerFuture(concurrent.futures.Future):
    def __init__(self, must_stop: Callable[[], bool]) -> None:
        super().__init__()
        self._must_stop = must_stop

    def result(self, timeout: float | None = None) -> Any:
        """Wait for the result; raise JobAbandoned once `must_stop()` returns True."""
        while not concurrent.futures.wait([self], 0.2).done:
            if self._must_stop():
                raise JobAbandoned
        return super().result(timeout)


class JobThreads:
    """Two daemon threads that run jobs in order of submission; they do not block the end of the process.

    Jobs for whose results a step waits (`Job.after`) have a thread of their own: they never wait for the
    others, which may write to a slow disk. The threads of `concurrent.futures` executors would block the end.
    """

    def __init__(self, must_stop: Callable[[], bool]) -> None:
        self._must_stop = must_stop
        self._awaited, self._others = _queue_of_thread("job"), _queue_of_thread("job-unawaited")

    def submit(self, job: Job) -> concurrent.futures.Future:
        """Queue a job and return its future."""
        future = _WorkerFuture(self._must_stop)
        (self._others if job.after is None else self._awaited).put((future, job.run))
        return future


_Queue = queue.SimpleQueue[tuple[_WorkerFuture, Callable[[], Any]]]


def _queue_of_thread(name: str) -> _Queue:
    """Return the queue of a new thread that runs the jobs in it."""
    waiting: _Queue = queue.SimpleQueue()
    threading.Thread(target=_work, args=(waiting,), name=name, daemon=True).start()
    return waiting


def _work(waiting: _Queue) -> None:
    while True:
        future, run = waiting.get()
        try:
            future.set_result(run())
        except BaseException as error:  # re-raised by `result()`
            future.set_exception(error)
        del future, run  # else a result stays in memory until the next job


@dataclass
class _Pending(Generic[_FutureT]):
    job: Job
    future: _FutureT
    remaining: int | None  # messages until the result is due; None = when the job is finished


class JobQueue(Generic[_FutureT]):
    """Jobs that one node has started and whose results it has not received yet."""

    def __init__(self, submit: Callable[[Job], _FutureT]) -> None:
        self._submit = submit
        self._pending: list[_Pending[_FutureT]] = []

    def start(self, job: Job) -> _FutureT:
        """Submit `job` for execution in the background and return its future."""
        future = self._submit(job)
        self._pending.append(_Pending(job, future, job.after))
        return future

    def before_message(self, topic: str) -> Iterator[tuple[str, Any]]:
        """Yield (name, result) of the jobs whose result is due before the next message, which is on `topic`.

        Jobs that have not finished are waited for.
        """
        for pending in self._pending:
            if pending.remaining is not None and pending.job.of in (None, topic):
                pending.remaining -= 1
        due = [p for p in self._pending if p.remaining is not None and p.remaining <= 0]
        yield from self._take(due)

    def finished(self) -> Iterator[tuple[str, Any]]:
        """Yield (name, result) of the finished jobs that have no fixed delivery point (`after` is None)."""
        yield from self._take([p for p in self._pending if p.remaining is None and p.future.done()])

    def result_of(self, future: _FutureT) -> Iterator[tuple[str, Any]]:
        """Yield (name, result) of the job of `future`, unless its result was delivered already."""
        yield from self._take([p for p in self._pending if p.future is future])

    def remaining_results(self) -> Iterator[tuple[str, Any]]:
        """Wait for all jobs and yield (name, result), including jobs that are started meanwhile."""
        while self._pending:
            yield from self._take(self._pending[:1])

    def _take(self, due: list[_Pending[_FutureT]]) -> Iterator[tuple[str, Any]]:
        for pending in due:
            self._pending.remove(pending)
            yield pending.job.name, pending.future.result()
