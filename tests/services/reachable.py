"""Size of everything that is reachable from an object: entries of containers and bytes of arrays, by path."""

from __future__ import annotations

import functools
import logging
import threading
import types
from collections import Counter, deque
from typing import Any

import numpy as np

_LEAVES = (
    str, bytes, int, float, complex, bool, type(None), type, types.ModuleType, types.FunctionType,
    types.BuiltinFunctionType, logging.Logger, threading.Thread,
)  # fmt: skip


def reachable(root: object) -> Counter[str]:
    """Return, by path of attributes, the number of entries of all containers and the bytes of all arrays / 64.

    Entries of a container share the path of the container. Classes, modules, functions, threads and objects of
    extension modules are not entered.
    """
    sizes: Counter[str] = Counter()
    seen: set[int] = set()
    keep: list[Any] = []  # so that ids are not used again
    pending: list[tuple[str, Any]] = [("node", root)]
    while pending:
        path, value = pending.pop()
        if isinstance(value, _LEAVES) or id(value) in seen:
            continue
        seen.add(id(value))
        keep.append(value)
        if isinstance(value, np.ndarray):
            base = value if value.base is None else value.base
            sizes[path] += (base.nbytes if isinstance(base, np.ndarray) else value.nbytes) // 64
        elif isinstance(value, dict):
            sizes[path] += len(value)
            pending += [(f"{path}[]", entry) for entry in value.values()]
        elif isinstance(value, (list, tuple, set, frozenset, deque)):
            sizes[path] += len(value)
            pending += [(f"{path}[]", entry) for entry in value]
        elif isinstance(value, functools.partial):
            pending.append((path, [value.func, value.args, value.keywords]))
        elif isinstance(value, types.MethodType):
            pending.append((path, value.__self__))
        else:
            names = [name for cls in type(value).__mro__ for name in getattr(cls, "__slots__", ())]
            slots = {name: getattr(value, name, None) for name in names if isinstance(name, str)}
            attributes = slots | getattr(value, "__dict__", {})
            pending += [(f"{path}.{name}", entry) for name, entry in attributes.items()]
    return sizes
