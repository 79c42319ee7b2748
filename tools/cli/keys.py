"""`beamsplat keys`: certificates for the hosts of a fleet, and what each may do."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from beamsplat.common.config.base import parse
from beamsplat.common.errors import UserError

app = typer.Typer(no_args_is_help=True, help="Certificates for links between hosts.")
DEFAULT = Path("~/.config/beamsplat/authority")
FolderOption = Annotated[Path, typer.Option("--authority", help="Folder of the authority")]
NameArgument = Annotated[str, typer.Argument(help="Name of the host: lower case, digits, - and _")]


@app.command()
def init(authority: FolderOption = DEFAULT) -> None:
    """Makes the authority that all hosts trust, once. Keep its folder to yourself.

    Example: beamsplat keys init
    """
    from beamsplat.tools.keys.pki import Authority

    made = Authority.create(authority)
    print(f"{made.folder}: an authority. Next: beamsplat keys issue edge --role edge --address edge.local")


@app.command()
def issue(
    name: NameArgument,
    role: Annotated[
        str, typer.Option(help="robot, edge, monitor (reads) or operator (also changes)")
    ] = "robot",
    robot: Annotated[
        str | None, typer.Option(help="Whose topics; default: a robot's own name, else all (*)")
    ] = None,
    address: Annotated[
        list[str] | None, typer.Option(help="Name or IP address by which others reach it; repeatable")
    ] = None,
    days: Annotated[int, typer.Option(min=1, max=825, help="Valid for so long")] = 90,
    authority: FolderOption = DEFAULT,
) -> None:
    """Makes a host's key and certificate, or new ones before the old expire, and says where to copy them.

    Examples:

        beamsplat keys issue edge --role edge --address edge.local --address 192.168.1.5

        beamsplat keys issue robot1
    """
    from beamsplat.common.security.access_control import HostRole
    from beamsplat.tools.keys.pki import Authority, expiry

    if not (name.isascii() and name.replace("-", "a").replace("_", "a").isalnum() and name == name.lower()):
        raise UserError(f"{name!r}: a host's name has lower case letters, digits, - and _ only")
    whose = robot or (name if role == "robot" else "*")
    host = parse(HostRole, {"role": role, "robot": whose}, f"host {name!r}")
    folder = Authority(authority).issue(name, host, tuple(address or ()), days)
    print(f"{folder}: copy it to {name} as the folder that `security.keys` names; valid until "
          f"{expiry(folder / 'host.pem')}")  # fmt: skip


@app.command()
def remove(name: NameArgument, authority: FolderOption = DEFAULT) -> None:
    """Takes a host out of the policy: a running edge router on this machine notices within a second.

    Example: beamsplat keys remove robot1
    """
    from beamsplat.tools.keys.pki import Authority

    found = Authority(authority)
    found.remove(name)
    edges = ", ".join(str(folder / "hosts.toml") for folder in found.edges()) or "no edge yet"
    print(f"{name} is removed. The policy of the edges is renewed ({edges}): copy it to edges elsewhere")


@app.command(name="list")
def list_hosts(authority: FolderOption = DEFAULT) -> None:
    """Every host, its role and when its certificate ends.

    Example: beamsplat keys list
    """
    from beamsplat.tools.keys.pki import Authority, expiry

    found = Authority(authority)
    for name, host in found.hosts().items():
        certificate = found.folder / "hosts" / name / "host.pem"
        until = expiry(certificate) if certificate.exists() else "its files are gone"
        print(f"{name:<20} {host.role:<9} robot {host.robot:<12} {until}")
