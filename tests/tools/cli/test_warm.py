"""`beamsplat warm` leaves no kernel to be compiled while a robot drives."""

import importlib
import pkgutil

import pytest
from numba.core.registry import CPUDispatcher

from beamsplat.tools.cli.warm import WARMERS


def _kernels(package):
    """module.name -> kernel, of all modules of a package."""
    found = {}
    for info in pkgutil.iter_modules(importlib.import_module(package).__path__):
        if not info.ispkg and info.name not in ("node", "cli"):
            module = importlib.import_module(f"{package}.{info.name}")
            for name, value in vars(module).items():
                if isinstance(value, CPUDispatcher) and value.py_func.__module__ == module.__name__:
                    found[f"{info.name}.{name}"] = value
    return found


@pytest.mark.slow
@pytest.mark.parametrize("entry", WARMERS)
def test_every_kernel_that_python_calls_is_compiled(entry):
    module_name, _, function = entry.partition(":")
    getattr(importlib.import_module(module_name), function)()
    kernels = _kernels(module_name.rpartition(".")[0])
    # What other kernels call is compiled with them.
    inner = {name for kernel in kernels.values() for name in kernel.py_func.__code__.co_names}
    outer = {key: kernel for key, kernel in kernels.items() if kernel.py_func.__name__ not in inner}
    assert outer
    assert [key for key, kernel in outer.items() if not kernel.signatures] == []
