"""Background jobs of a node, taken in at points that depend on messages, not on speed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

from common.node import Job


class Future(Protocol):
    """What `concurrent.futures.Future` has of interest here."""

    def result(self) -> Any: ...

    def done(self) -> bool: ...


class Deferred:
    """A future that runs when its result is asked for: one thread, reproducible."""

    def __init__(self, run: Callable[[], Any]) -> None:
        self._run = run

    def result(self) -> Any:
        return self._run()

    def done(self) -> bool:
        return False


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
