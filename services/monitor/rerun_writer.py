"""Writing of rerun entries to a viewer, a file, or both, each in its own thread.

rerun can write one stream to several sinks (`set_sinks`), but the slowest sink then delays all others: a
browser that stops reading blocks `log()`, and thus also the file, for more than 20 s. Therefore each sink has
its own stream of the same recording, and a queue that never blocks the caller: if the queue is full (number
of entries or bytes), a new entry replaces the queued entry of the same path.

rerun keeps an index of each open file in memory, about 0.5 kB per chunk of entries. A long recording is
therefore written as several files, its parts; each begins with the entries that hold at all times, so that it
can be opened alone.
"""

from __future__ import annotations

import logging
import shutil
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from beamsplat.common.errors import reason
from beamsplat.common.files.persist import is_disk_fault

log = logging.getLogger(__name__)

APPLICATION = "beamsplat"
TIMELINE = "time"
_QUEUE = 256  # about five seconds of entries at the default rates
_QUEUE_BYTES = 64_000_000  # a large map has about 13 MB and is drawn every two seconds
_CHECK_S = 1.0  # between checks that the sink still works
_FLUSH_S = 3.0
_FILE_FLUSH_S = 5.0  # between two writes to a file: a killed process loses so much
_PART_ENTRIES = 100_000  # of one file, which take at most 50 MB of memory until it is closed
_PART_MB = 1000.0  # of one file


@dataclass
class _LogEntry:
    path: str
    parts: tuple[Any, ...]
    stamp_ns: int | None
    static: bool
    bytes: int = 0


class RerunSinkThread:
    """A viewer server, or the file or files of a recording, and the thread that writes to it."""

    def __init__(
        self,
        name: str,
        stream: rr.RecordingStream,
        sink: Any,
        blueprint: rrb.Blueprint,
        watch: Callable[[], str] = lambda: "",
        next_part: Callable[[int], Any | None] = lambda entries: None,
        flush_s: float = _CHECK_S,
    ) -> None:
        """Open the sink and start the thread.

        Args:
            name: name of the sink, for status texts.
            stream: rerun stream that only this sink uses.
            sink: the rerun sink to open.
            blueprint: layout of the viewer.
            watch: called about once per second; returns the reason why the sink must be closed, or "".
            next_part: called about once per second with the number of entries in the sink; returns the sink
                that continues the recording, or None while the present one does.
            flush_s: time between two checks that the sink has taken all entries.

        Raises:
            RuntimeError: the sink cannot be opened.
        """
        self.name = name
        self.fault = ""  # why the sink was closed
        self.dropped = 0  # entries replaced by newer ones
        self._stream = stream
        self._watch = watch
        self._next_part = next_part
        self._static: dict[tuple[str, tuple[type, ...]], _LogEntry] = {}  # begin each part
        self._queue: deque[_LogEntry | threading.Event] = deque()
        self._newest: dict[str, _LogEntry] = {}
        self._bytes = 0  # of the queued entries
        self._changed = threading.Condition()
        self._closing = False
        self._flush_s, self._next_flush = flush_s, time.monotonic() + flush_s
        self._open(sink, blueprint)
        self._thread = threading.Thread(target=self._run, name=f"monitor-{name}", daemon=True)
        self._thread.start()

    def _open(self, sink: Any, blueprint: rrb.Blueprint | None) -> None:
        self._stream.set_sinks(sink, default_blueprint=blueprint)
        self._entries = 0  # in this part

    def put(self, entry: _LogEntry) -> None:
        """Queue one entry; never blocks."""
        if self.fault:
            return
        with self._changed:
            waiting = self._newest.get(entry.path)
            full = len(self._queue) >= _QUEUE or self._bytes + entry.bytes > _QUEUE_BYTES
            if full and waiting is not None:
                self._bytes += entry.bytes - waiting.bytes
                waiting.parts, waiting.stamp_ns, waiting.bytes = (
                    entry.parts,
                    entry.stamp_ns,
                    entry.bytes,
                )
                self.dropped += 1
                return
            entry = replace(entry)
            self._queue.append(entry)
            self._bytes += entry.bytes
            self._newest[entry.path] = entry
            self._changed.notify()

    def flush(self, timeout_s: float) -> bool:
        """Wait until all queued entries are written; return False after `timeout_s`."""
        done = threading.Event()
        with self._changed:
            self._queue.append(done)
            self._changed.notify()
        return bool(self.fault) or done.wait(timeout_s)

    def begin_close(self) -> None:
        """Request the thread to write the queued entries and then close the sink; do not wait."""
        with self._changed:
            self._closing = True
            self._changed.notify()

    def close(self, timeout_s: float) -> None:
        """Close the sink; wait at most `timeout_s` for the thread."""
        self.begin_close()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            log.warning("%s was not closed within %g s: its last entries are missing", self.name, timeout_s)

    def _run(self) -> None:
        next_check = time.monotonic() + _CHECK_S
        while not self.fault and (item := self._take()) != "closing":
            try:
                if isinstance(item, threading.Event):
                    self._stream.flush(timeout_sec=_FLUSH_S)
                    item.set()
                elif item is not None:
                    self._write(item)
                if time.monotonic() >= next_check:
                    self._check_sink()
                    next_check = time.monotonic() + _CHECK_S
            except RuntimeError as error:  # raised by rerun when a sink has failed
                self._give_up(str(error))
        try:
            if not self.fault:
                self._stream.flush(timeout_sec=_FLUSH_S)
            self._stream.disconnect()
        except RuntimeError as error:
            self._give_up(str(error))

    def _take(self) -> _LogEntry | threading.Event | Literal["closing"] | None:
        with self._changed:
            if not self._queue and not self._closing:
                self._changed.wait(_CHECK_S)
            if not self._queue:
                return "closing" if self._closing else None
            item = self._queue.popleft()
            if isinstance(item, _LogEntry):
                self._bytes -= item.bytes
                if self._newest.get(item.path) is item:
                    del self._newest[item.path]
            return item

    def _write(self, entry: _LogEntry) -> None:
        self._stream.reset_time()
        if entry.stamp_ns is not None:
            self._stream.set_time(TIMELINE, timestamp=np.datetime64(entry.stamp_ns, "ns"))
        self._stream.log(entry.path, *entry.parts, static=entry.static)
        self._entries += 1
        if entry.static:
            self._static[entry.path, tuple(map(type, entry.parts))] = entry

    def _check_sink(self) -> None:
        if time.monotonic() >= self._next_flush:
            self._next_flush = time.monotonic() + self._flush_s
            try:
                self._stream.flush(timeout_sec=0.2)
            except RuntimeError as error:
                if "timed out" not in str(error):  # slow, but not failed
                    raise
        reason = self._watch()
        if reason:
            self._give_up(reason)
        elif part := self._next_part(self._entries):
            self._stream.flush(timeout_sec=_FLUSH_S)
            # rerun never ends the threads of a stream, and each blueprint is one: only the first part has it.
            self._open(part, None)
            for entry in self._static.values():
                self._write(entry)

    def _give_up(self, reason: str) -> None:
        if not self.fault:
            self.fault = f"{self.name}: {reason}"
            log.warning("the monitor continues without %s", self.fault)
        with self._changed:
            self._queue.clear()
            self._newest.clear()
            self._bytes = 0


class RerunWriter:
    """Writes entries to all sinks. Logging never blocks and never raises."""

    def __init__(self) -> None:
        self.sinks: list[RerunSinkThread] = []
        self.notes: list[str] = []  # addresses and files, for the status
        self._recording_id = np.random.default_rng().bytes(16).hex()
        self._viewer: subprocess.Popen[bytes] | None = None

    def log(self, path: str, *parts: Any, stamp_ns: int | None = None, static: bool = False) -> None:
        """Write rerun archetypes to the entity `path` at the time `stamp_ns`; None: rerun's log time only."""
        entry = _LogEntry(path, parts, stamp_ns, static, sum(map(_size_bytes, parts)))
        for thread in self.sinks:
            thread.put(entry)

    def save(self, path: Path, blueprint: rrb.Blueprint, *, limit_mb: int, keep_free_mb: int) -> Path:
        """Start a file under a name that does not exist yet (drive.rrd, drive-2.rrd, ...); return its path.

        A long recording continues in drive.part2.rrd and so on; `rerun drive*.rrd` shows them as one. It is
        closed, complete, at `limit_mb`, or when less than `keep_free_mb` are free on the disk.

        On a disk that is full, read-only or broken, a note says so, and nothing is saved.

        Raises:
            RuntimeError: the file cannot be written for another reason.
        """
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path = _unused_path(path)
            _check_room(path)
        except OSError as error:
            if is_disk_fault(error):
                self.notes.append(f"NOT SAVED: {path}: {reason(error)}")
                log.error("%s", self.notes[-1])
                return path
            raise RuntimeError(f"cannot create the folder of {path}: {error}") from error
        parts = _FileParts(path, limit_mb, keep_free_mb)

        def next_part(entries: int) -> rr.FileSink | None:
            following = parts.next(entries)
            return None if following is None else rr.FileSink(following)

        # Few, large chunks: rerun keeps their index in memory until the file is closed.
        stream = self._stream(flush_tick_s=_FILE_FLUSH_S)
        self.sinks.append(
            RerunSinkThread(
                str(path), stream, rr.FileSink(path), blueprint, parts.watch, next_part, _FILE_FLUSH_S
            )
        )
        self.notes.append(f"writing {path}")
        return path

    def serve(
        self, blueprint: rrb.Blueprint, *, bind: str, port: int, origins: list[str], memory_mb: int
    ) -> str:
        """Start the server to which viewers connect; return its address.

        The server stores up to `memory_mb` of entries for viewers that connect later.

        Raises:
            RuntimeError: the port is in use.
        """
        sink = rr.GrpcServerSink(
            bind, port, server_memory_limit=f"{memory_mb}MB", cors_allow_origin=origins or None
        )
        thread = RerunSinkThread(
            f"viewer at port {port}", self._stream(0.1), sink, blueprint, self._watch_viewer
        )
        self.sinks.append(thread)
        return f"rerun+http://127.0.0.1:{port}/proxy"

    def spawn(self, address: str, memory_mb: int) -> None:
        """Open a viewer window connected to the server at `address`; it remains when the monitor ends."""
        self._viewer = subprocess.Popen(
            [sys.executable, "-m", "rerun_cli", "--connect", address, "--bind", "127.0.0.1",
             "--memory-limit", f"{memory_mb}MB"],
            stdin=subprocess.DEVNULL,
            start_new_session=True,
        )  # fmt: skip

    def _watch_viewer(self) -> str:
        """Add a note if the viewer window was closed, and return "".

        The server continues, so that a new viewer can connect.
        """
        if self._viewer is not None and self._viewer.poll() is not None:
            self._viewer = None
            self.notes.append(
                'the viewer window was closed; the data are still served (no display: set view = "serve")'
            )
            log.warning("%s", self.notes[-1])
        return ""

    def _stream(self, flush_tick_s: float) -> rr.RecordingStream:
        config = rr.ChunkBatcherConfig(flush_tick=flush_tick_s)
        return rr.RecordingStream(APPLICATION, recording_id=self._recording_id, batcher_config=config)

    @property
    def status(self) -> str:
        """Return one line of text: addresses, files, and failed sinks."""
        parts = [*self.notes]
        for thread in self.sinks:
            if thread.fault:
                parts.append(f"stopped: {thread.fault}")
            elif thread.dropped:
                parts.append(f"{thread.name} is slow: {thread.dropped} entries dropped")
        return "; ".join(parts)

    def flush(self, timeout_s: float = _FLUSH_S) -> None:
        """Wait at most `timeout_s` for each sink to write its queue."""
        for thread in self.sinks:
            thread.flush(timeout_s)

    def close(self, timeout_s: float = _FLUSH_S) -> None:
        """Close files and servers, all within `timeout_s`."""
        deadline = time.monotonic() + timeout_s
        for thread in self.sinks:
            thread.begin_close()
        for thread in self.sinks:
            thread.close(max(deadline - time.monotonic(), 0.0))


def _size_bytes(archetype: Any) -> int:
    return sum(batch.as_arrow_array().nbytes for batch in archetype.as_component_batches())


def _check_room(path: Path) -> None:
    """Check that a new file can be written: rerun does not tell why it cannot.

    Raises:
        OSError: the disk is full, read-only or broken.
    """
    try:
        with path.open("xb", buffering=0) as file:
            file.write(bytes(4096))
    finally:
        path.unlink(missing_ok=True)


def _unused_path(path: Path) -> Path:
    """Return `path`, or the first of path-2, path-3, ... that does not exist; no file is overwritten."""
    candidate, number = path, 1
    while candidate.exists():
        number += 1
        candidate = path.with_stem(f"{path.stem}-{number}")
    return candidate


class _FileParts:
    """The files of one recording (drive.rrd, drive.part2.rrd, ...) and their limits."""

    def __init__(self, first: Path, limit_mb: int, keep_free_mb: int) -> None:
        self._first, self._current = first, first
        self._limit_mb, self._keep_free_mb = limit_mb, keep_free_mb
        self._number, self._closed_mb, self._size_mb = 1, 0.0, 0.0

    def watch(self) -> str:
        """Return the reason to end the recording, or ""."""
        path = self._current
        try:
            self._size_mb = path.stat().st_size / 1e6
            free_mb = shutil.disk_usage(path.parent).free / 1e6
        except OSError as error:
            return f"the file was removed ({error})"
        size_mb = self._closed_mb + self._size_mb
        if size_mb > self._limit_mb:
            return f"closed at {size_mb:.0f} MB (save_limit_mb = {self._limit_mb})"
        if free_mb < self._keep_free_mb:
            return f"closed: {free_mb:.0f} MB left on the disk (keep_free_mb = {self._keep_free_mb})"
        return ""

    def next(self, entries: int) -> Path | None:
        """Return the file of the next part if the present one is full: by its entries, or its last size."""
        if entries < _PART_ENTRIES and self._size_mb < _PART_MB:
            return None
        self._closed_mb += self._size_mb
        self._size_mb = 0.0
        self._number += 1
        self._current = _unused_path(self._first.with_stem(f"{self._first.stem}.part{self._number}"))
        return self._current
