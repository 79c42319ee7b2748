"""Background jobs of a node, taken in at points that depend on messages, not on speed."""

from __future__ import annotations

import concurrent.futures
import queue
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

from beamsplat.common.runtime.node import Job


class Future(Protocol):
    """What `concurrent.futures.Future` has of interest here."""

    def result(self) -> Any: ...

    def done(self) -> bool: ...


class LazyFuture:
    """A future that runs when its result is asked for: one thread, reproducible."""

    def __init__(self, run: Callable[[], Any]) -> None:
        self._run = run

    def result(self) -> Any:
        return self._run()

    def done(self) -> bool:
        return False


class JobAbandoned(Exception):
    """A job that was waited for takes too long for a process that is to end."""


class _WorkerFuture(concurrent.futures.Future):
    def __init__(self, gave_up: Callable[[], bool]) -> None:
        super().__init__()
        self._gave_up = gave_up

    def result(self, timeout: float | None = None) -> Any:
        """Raises JobAbandoned once the process is to end and has waited long enough."""
        while not concurrent.futures.wait([self], 0.2).done:
            if self._gave_up():
                raise JobAbandoned
        return super().result(timeout)


class JobThread:
    """One thread that runs jobs in turn. Unlike a pool's it does not keep the process from ending."""

    def __init__(self, gave_up: Callable[[], bool]) -> None:
        self._gave_up = gave_up
        self._waiting: queue.SimpleQueue[tuple[_WorkerFuture, Callable[[], Any]]] = queue.SimpleQueue()
        threading.Thread(target=self._work, name="job", daemon=True).start()

    def submit(self, run: Callable[[], Any]) -> Future:
        """Runs it when those before it are done."""
        future = _WorkerFuture(self._gave_up)
        self._waiting.put((future, run))
        return future

    def _work(self) -> None:
        while True:
            future, run = self._waiting.get()
            try:
                future.set_result(run())
            except BaseException as error:  # raised where the result is asked for
                future.set_exception(error)


@dataclass
class _Pending:
    job: Job
    future: Future
    remaining: int | None


class JobQueue:
    """Jobs started by one node and not yet taken in."""

    def __init__(self, submit: Callable[[Callable[[], Any]], Future]) -> None:
        self._submit = submit
        self._pending: list[_Pending] = []

    def start(self, job: Job) -> Future:
        """Begins a job."""
        future = self._submit(job.run)
        self._pending.append(_Pending(job, future, job.after))
        return future

    def before_message(self, topic: str) -> Iterator[tuple[str, Any]]:
        """(name, result) of the jobs due before this message; waits for those that must be in."""
        for pending in self._pending:
            if pending.remaining is not None and pending.job.of in (None, topic):
                pending.remaining -= 1
        due = [p for p in self._pending if p.remaining is not None and p.remaining <= 0]
        yield from self._take(due)

    def finished(self) -> Iterator[tuple[str, Any]]:
        """(name, result) of the jobs that are taken in when they are done, and are."""
        yield from self._take([p for p in self._pending if p.remaining is None and p.future.done()])

    def take(self, future: Future) -> Iterator[tuple[str, Any]]:
        """(name, result) of the job behind `future`, unless it has been taken in already."""
        yield from self._take([p for p in self._pending if p.future is future])

    def rest(self) -> Iterator[tuple[str, Any]]:
        """(name, result) of all jobs, also of those that these lead to."""
        while self._pending:
            yield from self._take(self._pending[:1])

    def _take(self, due: list[_Pending]) -> Iterator[tuple[str, Any]]:
        for pending in due:
            self._pending.remove(pending)
            yield pending.job.name, pending.future.result()
