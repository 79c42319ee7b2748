"""`beamsplat bug-report`: write everything that is needed to diagnose a fault into one file."""

from __future__ import annotations

import time
import zipfile
from pathlib import Path
from typing import Annotated, Any

import typer

from beamsplat.common.config.deployment import Deployment, load_deployment
from beamsplat.common.errors import UserError, reason
from beamsplat.tools.cli.options import writable


def bug_report(
    out: Annotated[Path, typer.Option(callback=writable, help="NAME.zip to write")],
    file: Annotated[
        Path | None, typer.Argument(metavar="[DEPLOYMENT]", help="Deployment file of the system")
    ] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="NODE.OPTION=VALUE", help="As given to `run`")
    ] = None,
) -> None:
    """Write versions, platform, deployment, logs, doctor's findings and health into one ZIP file.

    Passwords, tokens and keys are removed from it. The health is included if the system runs.

    Example: beamsplat bug-report deploy/robot.toml --out report.zip
    """
    from beamsplat.common.files.persist import make_folder, write_atomically
    from beamsplat.tools.cli.doctor import examine
    from beamsplat.tools.system.bug_report import bundle

    if out.suffix != ".zip":
        raise UserError(f"--out {out}: expected a name ending in .zip")
    deployment = load_deployment(file, tuple(set_ or ())) if file is not None else Deployment()
    data = bundle(deployment, lambda: examine(deployment), lambda: _health(deployment))
    try:
        write_atomically(make_folder(out.parent) / out.name, data)
    except OSError as error:
        raise UserError(f"--out {out}: cannot be written ({reason(error)})") from error
    with zipfile.ZipFile(out) as written:
        names = ", ".join(written.namelist())
    print(f"{out}: {len(data) / 1e3:.0f} kB: {names}")
    print("Read it before you publish it: logs can contain names of files, hosts and robots.")


def _health(deployment: Deployment) -> dict[str, Any]:
    from beamsplat.common.security.logins import OPERATOR, login_of
    from beamsplat.common.zenoh.bus import open_session
    from beamsplat.tools.system.bug_report import HEALTH_S
    from beamsplat.tools.system.health_table import HealthTable

    login = login_of(deployment.security, OPERATOR)
    with open_session(deployment.router.listen, 0.5, login=login) as session:
        board = HealthTable(session, deployment.robot)
        time.sleep(HEALTH_S)
        return board.snapshot()
