"""The kernels that a piece of code compiles or loads, observed in a process of its own."""

import json
import subprocess
import sys
import textwrap
from pathlib import Path

_SCRIPT = """
import json, sys
from numba.core.dispatcher import Dispatcher

def kernels():
    return {
        f"{module.__name__}.{name}{signature}"
        for module in list(sys.modules.values())
        if getattr(module, "__name__", "").startswith("beamsplat.")
        for name, value in vars(module).items()
        if isinstance(value, Dispatcher) and value.targetoptions.get("nogil")
        for signature in value.signatures
    }

exec(sys.argv[1], {})
warm = kernels()
exec(sys.argv[2], {})
print(json.dumps([sorted(warm), sorted(kernels() - warm)]))
"""


def kernels_of(warm: str, use: str) -> tuple[list[str], list[str]]:
    """Run two pieces of code; return the kernels after the first, and those that only the second needed."""
    done = subprocess.run(
        [sys.executable, "-c", _SCRIPT, textwrap.dedent(warm), textwrap.dedent(use)],
        capture_output=True, text=True, check=False, timeout=600, cwd=Path(__file__).parents[2],
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    first, more = json.loads(done.stdout.splitlines()[-1])
    return first, more
