"""Read the end of the log of a process, also of a rotated one, and find in it why the process ended."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import NamedTuple

_TAIL_BYTES = 256 * 1024  # a traceback and what was logged after it
_LOG_LINE = re.compile(r"^\d{4}-\d\d-\d\d [\d:,]+ (?P<level>[A-Z]+) +[^ :]+: (?P<text>.*)")  # start_logging()
_FATAL = re.compile(r"^(Fatal Python error: |terminate called|thread '.*' panicked at)")
_TRACEBACK = "Traceback (most recent call last):"


class LogPosition(NamedTuple):
    """A place in a log that may be rotated later."""

    inode: int
    offset: int  # bytes


def rotated(path: Path) -> Path:
    """Return the path of the older part of a log."""
    return path.with_name(f"{path.name}.1")


def log_position(path: Path) -> LogPosition:
    """Return the present end of a log; it need not exist."""
    try:
        status = path.stat()
    except OSError:
        return LogPosition(0, 0)
    return LogPosition(status.st_ino, status.st_size)


def log_tail(path: Path, most_bytes: int, since: LogPosition | None = None) -> str:
    """Return the end of a log, at most `most_bytes`, with its older part if that is needed.

    `since` is where the log of this process begins, after those of earlier processes; None: all.

    Raises:
        OSError: the log cannot be read.
    """
    found = b""
    for part in (path, rotated(path)):
        if part != path and not part.exists():
            break
        with part.open("rb") as file:
            inode, size = os.fstat(file.fileno()).st_ino, file.seek(0, 2)
            is_start = since is not None and inode == since.inode and since.offset <= size
            first = since.offset if since is not None and is_start else 0
            file.seek(max(first, size - (most_bytes - len(found))))
            found = file.read() + found
        if is_start or len(found) >= most_bytes:
            break
    return found.decode(errors="replace")


def last_error(path: Path, since: LogPosition | None = None) -> str:
    """Return the last error in a log file in one line, without time and logger name.

    The last error is the exception of the last traceback, or the last line of level ERROR or CRITICAL,
    whichever is later. A log without errors: the last line.

    Args:
        since: where the log of this process begins, after those of earlier processes; None: all.
    """
    try:
        lines = log_tail(path, _TAIL_BYTES, since).splitlines()
    except OSError:
        return f"no log at {path}"
    for number in reversed(range(len(lines))):
        line = lines[number]
        entry = _LOG_LINE.match(line)
        if entry is not None and entry["level"] in ("ERROR", "CRITICAL"):
            return entry["text"]
        if _FATAL.match(line):
            return line
        if line.strip() == _TRACEBACK:
            indent = len(line) - len(line.lstrip())
            after = (text for text in lines[number + 1 :] if len(text) - len(text.lstrip()) <= indent)
            if (raised := next(filter(str.strip, after), None)) is not None:
                return raised.strip()
    written = [line for line in lines if line.strip()]
    if not written:
        return f"nothing in {path}"
    entry = _LOG_LINE.match(written[-1])
    return written[-1].strip() if entry is None else entry["text"]
