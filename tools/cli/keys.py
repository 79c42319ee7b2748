"""`beamsplat keys`: certificates of the hosts of a fleet, and their access rights."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from beamsplat.common.config.base import parse
from beamsplat.common.errors import UserError

app = typer.Typer(no_args_is_help=True, help="Certificates for links between hosts.")
DEFAULT = Path("~/.config/beamsplat/authority")
_DATE = "%Y-%m-%d %H:%M UTC"
FolderOption = Annotated[Path, typer.Option("--authority", help="Folder of the authority")]
NameArgument = Annotated[str, typer.Argument(help="Name of the host: lower case, digits, - and _")]


@app.command()
def init(authority: FolderOption = DEFAULT) -> None:
    """Create the certificate authority that all hosts trust. Do this once, and keep its folder secret.

    Example: beamsplat keys init
    """
    from beamsplat.tools.keys.pki import CertificateAuthority

    made = CertificateAuthority.create(authority)
    print(
        f"{made.folder}: authority created. Next: beamsplat keys issue edge --role edge --address edge.local"
    )


@app.command()
def issue(
    name: NameArgument,
    role: Annotated[
        str, typer.Option(help="robot, edge, monitor (reads) or operator (reads and changes)")
    ] = "robot",
    robot: Annotated[
        str | None,
        typer.Option(help="Robot whose topics the host may use; default: a robot's own name, else all (*)"),
    ] = None,
    address: Annotated[
        list[str] | None, typer.Option(help="Host name or IP address of the host; may be repeated")
    ] = None,
    days: Annotated[int, typer.Option(min=1, max=825, help="Validity in days")] = 90,
    authority: FolderOption = DEFAULT,
) -> None:
    """Create or renew the key and certificate of a host, and print which folder to copy to it.

    Examples:

        beamsplat keys issue edge --role edge --address edge.local --address 192.168.1.5

        beamsplat keys issue robot1
    """
    from beamsplat.common.security.access_control import HostRole
    from beamsplat.common.security.keys import CERTIFICATE
    from beamsplat.tools.keys.certificates import read_certificate
    from beamsplat.tools.keys.pki import CertificateAuthority

    if not (name.isascii() and name.replace("-", "a").replace("_", "a").isalnum() and name == name.lower()):
        raise UserError(f"{name!r}: the name of a host may have lower case letters, digits, - and _ only")
    whose = robot or (name if role == "robot" else "*")
    host = parse(HostRole, {"role": role, "robot": whose}, f"host {name!r}")
    folder = CertificateAuthority(authority).issue(name, host, tuple(address or ()), days)
    until = read_certificate(folder / CERTIFICATE).not_valid_after_utc
    print(f"{folder}: copy it to {name}, to the folder in `security.keys`; valid until {until:{_DATE}}")


@app.command()
def remove(name: NameArgument, authority: FolderOption = DEFAULT) -> None:
    """Remove a host from the policy. A running edge router on this machine applies it within a second.

    Example: beamsplat keys remove robot1
    """
    from beamsplat.tools.keys.pki import CertificateAuthority

    found = CertificateAuthority(authority)
    found.remove(name)
    edges = ", ".join(str(folder / "hosts.toml") for folder in found.edges()) or "no edge yet"
    print(f"{name} was removed. The edges' policy was written ({edges}): copy it to edges on other machines")


@app.command(name="list")
def list_hosts(authority: FolderOption = DEFAULT) -> None:
    """List every host, its role and the expiry of its certificate.

    Example: beamsplat keys list
    """
    from beamsplat.common.security.keys import CERTIFICATE
    from beamsplat.tools.keys.certificates import read_certificate
    from beamsplat.tools.keys.pki import CertificateAuthority

    found = CertificateAuthority(authority)
    for name, host in found.hosts().items():
        path = found.folder / "hosts" / name / CERTIFICATE
        until = (
            f"{read_certificate(path).not_valid_after_utc:{_DATE}}" if path.exists() else "files are missing"
        )
        print(f"{name:<20} {host.role:<9} robot {host.robot:<12} {until}")
