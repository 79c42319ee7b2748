"""Python packages that only some commands and nodes need, and the error texts if one is not installed."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Iterator
from contextlib import contextmanager

from packaging.requirements import Requirement

from beamsplat.common.errors import UserError

# Import name -> distribution, where they differ.
_DISTRIBUTIONS = {
    "rerun": "rerun-sdk", "zenoh": "eclipse-zenoh", "cv2": "opencv-python-headless", "serial": "pyserial",
}  # fmt: skip


def requirements() -> Iterator[tuple[Requirement, str]]:
    """Yield this package's requirements, each with the extra that it belongs to ("" = required by all)."""
    for line in importlib.metadata.requires("beamsplat") or ():
        requirement = Requirement(line)
        yield requirement, str(requirement.marker or "").partition("extra == ")[2].strip("\"'")


def remedy_for(module: str) -> str | None:
    """Return the command that installs a missing module, None if this package does not require it."""
    top = module.partition(".")[0]
    wanted = _DISTRIBUTIONS.get(top, top)
    for requirement, extra in requirements():
        if requirement.name == wanted and wanted != "beamsplat":
            return f"pip install 'beamsplat[{extra}]'" if extra else f"pip install '{wanted}'"
    return None


@contextmanager
def missing_packages_explained(who: str = "this") -> Iterator[None]:
    """Turn the ModuleNotFoundError of a package in this package's requirements into a UserError.

    Args:
        who: name of the command or node that needs the package; the subject of the error text.

    Raises:
        UserError: one sentence with the package and the command that installs it.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        remedy = remedy_for(error.name or "")
        if remedy is None:
            raise
        name = str(error.name).partition(".")[0]
        raise UserError(f"{who} needs the package {name}, which is not installed: {remedy}") from error
