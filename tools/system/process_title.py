"""Set the name of a process in `ps`, `top` and `htop`: children of a fork server all have the same name."""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path

_PR_SET_NAME = 15  # <linux/prctl.h>
_COMM_BYTES = 15  # TASK_COMM_LEN - 1
_ARG_START, _ARG_END = 48, 49  # fields of /proc/PID/stat, counted from 1: proc(5)


def set_process_title(title: str, *, arguments: bool = True) -> None:
    """Set the name of this process; call it from the main thread. Systems other than Linux: no effect.

    Args:
        title: the first 15 bytes become the command name (`/proc/self/comm`).
        arguments: also replace the command line (`/proc/self/cmdline`), in the memory that it occupies.
    """
    if sys.platform != "linux":
        return
    text = title.encode()
    ctypes.CDLL(None).prctl(_PR_SET_NAME, text[:_COMM_BYTES] + b"\0", 0, 0, 0)
    if arguments:
        fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()  # from field 3, the state
        start, end = int(fields[_ARG_START - 3]), int(fields[_ARG_END - 3])
        size = end - start
        if start and size > 2:  # 0: the system hides it
            # A last byte that is not 0 tells the kernel to show the text up to the first 0, and no more.
            ctypes.memmove(start, text[: size - 2].ljust(size - 1, b"\0") + b".", size)
