"""Classes that a deployment names as "module:Class", for implementations outside this package."""

from __future__ import annotations

import importlib
import sys
import traceback
from pathlib import Path

from beamsplat.common.errors import UserError


def is_class_path(name: str) -> bool:
    """Return whether `name` is the path of a class, "module:Class", and not the name of a shipped one."""
    return ":" in name


def load_class(path: str, option: str) -> type:
    """Import and return the class at "module:Class".

    Modules of the working directory can be imported; installed packages take precedence over them.

    Args:
        path: for example "my_package.my_node:MyNode".
        option: name of the option that contains the path, for error texts, for example "nodes.depth.kind".

    Raises:
        UserError: `path` has another form, there is no such module or class, or the module fails on import.
    """
    module_name, _, class_name = path.partition(":")
    if not all(part.isidentifier() for part in (*module_name.split("."), class_name)):
        raise UserError(
            f"{option} = {path!r}: expected 'module:Class', for example 'my_package.my_node:MyNode'"
        )
    folder = str(Path.cwd())
    if not {"", folder} & set(sys.path):
        sys.path.append(folder)
    try:
        module = importlib.import_module(module_name)
    except Exception as error:  # the module is not ours: its import may raise anything
        if isinstance(error, ModuleNotFoundError) and f"{module_name}.".startswith(f"{error.name}."):
            raise UserError(
                f"{option} = {path!r}: there is no module {error.name!r}, neither installed nor in {folder}"
            ) from error
        where = _place(error, module_name)
        raise UserError(f"{option} = {path!r}: {type(error).__name__}: {error}{where}") from error
    found = getattr(module, class_name, None)
    if not isinstance(found, type):
        raise UserError(f"{option} = {path!r}: {module.__file__} has no class {class_name!r}")
    return found


def _place(error: Exception, module_name: str) -> str:
    """Return " (file, line n)" of the innermost frame of the module's package in a traceback, or ""."""
    stem = module_name.partition(".")[0]
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        path = Path(frame.filename)
        if path.stem == stem or stem in path.parts:
            return f" ({path}, line {frame.lineno})"
    return ""
