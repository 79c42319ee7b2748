"""Checks of option values that several commands use."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from beamsplat.common.errors import UserError
from beamsplat.common.files.persist import check_can_write

if TYPE_CHECKING:
    import numpy as np

ScanTopic = Annotated[str, typer.Option(help="Topic of the lidar; needed if the choice is not clear.")]
ImageTopic = Annotated[str, typer.Option(help="Topic of the camera; needed if the choice is not clear.")]
OdometryTopic = Annotated[str, typer.Option(help="Topic of the wheel odometry, likewise.")]
CameraInfoTopic = Annotated[str, typer.Option(help="Topic of the camera's CameraInfo, likewise.")]


def writable(path: Path | None) -> Path | None:
    """Check that the path of the option `--out` can be written, and return it; a typer callback.

    Raises:
        UserError: no permission, or a parent of the path is a file.
    """
    if path is not None:
        check_can_write(path, "--out")
    return path


def session_folder(path: Path) -> Path:
    """Return the session in a folder: its subfolder `session` if there is one, else `path`; a typer callback.

    `beamsplat demo` writes such a subfolder. A deployment file (.toml) and a path that does not exist are
    returned unchanged.

    Raises:
        UserError: `path` is a file and no deployment.
    """
    from beamsplat.common.mapfiles.session import SessionFolder

    if path.is_file() and path.suffix != ".toml":
        raise UserError(
            f"{path} is a file: give the folder of a session, which `mapping.session = DIR` and "
            "`beamsplat demo` write, or for export and render the deployment file (.toml) of a running system"
        )
    inner = path / "session"
    return inner if not SessionFolder(path).exists() and SessionFolder(inner).exists() else path


def parsed_pose(text: str) -> np.ndarray:
    """Return the planar pose float64 [3] (x m, y m, yaw rad) of a text "X,Y,DEG" (m, m, degrees).

    Raises:
        UserError: the text has another form.
    """
    import numpy as np

    try:
        x_m, y_m, yaw_deg = (float(word) for word in text.split(","))
    except ValueError as error:
        raise UserError(f"--place {text!r}: expected X,Y,DEG, for example 12.4,-3.1,90") from error
    return np.array([x_m, y_m, np.radians(yaw_deg)])
