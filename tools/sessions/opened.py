"""Saved sessions as commands use them: locked, read, changed and written."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from beamsplat.common.errors import UserError

if TYPE_CHECKING:
    from beamsplat.common.files.numbered_state import Arrays
    from beamsplat.common.mapfiles.session import SessionFolder

console = Console(stderr=True)
ROBOT_MANIFEST = "lidar_map.json"


@contextlib.contextmanager
def locked(session: Path, shared: bool = False) -> Iterator[SessionFolder]:
    """Hold the lock of a session, from before it is read until its changes are written.

    Args:
        shared: for a session that is only read.

    Raises:
        UserError: there is no session, another process uses it, or it cannot be locked.
    """
    from beamsplat.common.mapfiles.session import SessionFolder

    folder = SessionFolder(session)
    folder.header()  # before a lock file is created
    try:
        folder.lock(shared)
    except OSError as error:
        raise UserError(f"{session}: cannot be locked ({error.strerror})") from error
    try:
        yield folder
    finally:
        folder.unlock()


@contextlib.contextmanager
def created(target: SessionFolder) -> Iterator[None]:
    """Create a session and hold its lock; it is removed again if nothing is written to it.

    Raises:
        UserError: it cannot be created, or another process has created it meanwhile.
    """
    with faults_explained(target):
        target.create()
        target.lock()
    try:
        if target.manifest() is not None:
            raise UserError(f"{target.path}: contains a session already; choose another folder")
        yield
    finally:
        target.unlock()


@contextlib.contextmanager
def faults_explained(folder: SessionFolder) -> Iterator[None]:
    """Convert the OSError of writing to a session to a UserError."""
    try:
        yield
    except OSError as error:
        raise UserError(
            f"{folder.path}: not written ({error.strerror}); what was saved before is still valid"
        ) from error


def read_saved(folder: SessionFolder) -> Arrays:
    """Return the arrays of the last checkpoint of a session.

    Raises:
        UserError: there is no checkpoint, or it cannot be read.
    """
    arrays = folder.read_state()
    if arrays is None:
        raise UserError(f"{folder.path}: nothing has been saved in this session yet")
    newer = newer_keyframes(folder, arrays)
    if newer:
        console.print(f"[yellow]{folder.path}: {newer} keyframes are newer than the checkpoint and not "
                      "included; a mapper that resumes inserts them[/]")  # fmt: skip
    return arrays


def newer_keyframes(folder: SessionFolder, arrays: Arrays) -> int:
    """Return the number of keyframes on disk that the checkpoint does not contain."""
    from beamsplat.common.mapfiles.state import progress_of

    known = {*arrays["extra_taken_id"].tolist(), *progress_of(arrays)["forgotten"]}
    return len(set(folder.keyframe_ids()) - known)


def write_saved(folder: SessionFolder, arrays: Arrays, slam: Any = None) -> None:
    """Write the state of a locked session, and the robot half `slam`, if one is given.

    Raises:
        UserError: the disk is full or broken.
    """
    from beamsplat.tools.sessions.edit import summary_of

    with faults_explained(folder):
        if slam is not None:
            slam.save(folder.robot)
        before = folder.manifest() or {}
        engine = {"engine": before["engine"]} if "engine" in before else {}
        folder.write_state(arrays, {**summary_of(arrays), **engine})
        folder.remove_blocks(folder.block_numbers())  # all Gaussians are in the state now


def load_slam(path: Path) -> Any:
    """Return the lidar SLAM that is saved in the robot half of a session.

    `path` is the folder of the saved state, or contains it as `state`.

    Raises:
        UserError: there is no saved state, or it cannot be read.
    """
    import numpy as np

    from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
    from beamsplat.services.localization.lidar2d.slam import LidarSlam

    folder = path if (path / ROBOT_MANIFEST).is_file() else path / "state"
    return LidarSlam.load(folder, LidarSlamSettings(), np.eye(4))  # T_body_lidar is needed for scans only
