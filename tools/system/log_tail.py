"""Find in the log of a process why it ended."""

from __future__ import annotations

import re
from pathlib import Path

_TAIL_BYTES = 256 * 1024  # a traceback and what was logged after it
_LOG_LINE = re.compile(r"^\d{4}-\d\d-\d\d [\d:,]+ (?P<level>[A-Z]+) +[^ :]+: (?P<text>.*)")  # start_logging()
_FATAL = re.compile(r"^(Fatal Python error: |terminate called|thread '.*' panicked at)")
_TRACEBACK = "Traceback (most recent call last):"


def last_error(path: Path, since: int = 0) -> str:
    """Return the last error in a log file in one line, without time and logger name.

    The last error is the exception of the last traceback, or the last line of level ERROR or CRITICAL,
    whichever is later. A log without errors: the last line.

    Args:
        since: offset in bytes at which the log of this process begins, after those of earlier processes.
    """
    try:
        with path.open("rb") as file:
            size = file.seek(0, 2)
            file.seek(max(since, size - _TAIL_BYTES))
            lines = file.read().decode(errors="replace").splitlines()
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
