"""Manage the certificate authority of a fleet: its key, the certificates of hosts, and their access rights.

Files in the folder of the authority:

    ca.key      private key of the authority; stays in this folder
    ca.pem      root certificate that all hosts trust
    hosts.toml  the policy: every host that was issued and not removed; each edge has a copy
    hosts/NAME  to be copied to that host: ca.pem, host.pem, host.key (and hosts.toml for an edge)
"""

from __future__ import annotations

import shutil
from datetime import UTC, datetime
from pathlib import Path

from beamsplat.common.errors import UserError
from beamsplat.common.files.persist import make_folder, write_atomically
from beamsplat.common.security.access_control import HostRole, read_hosts
from beamsplat.common.security.keys import CA, CERTIFICATE, HOSTS, KEY, write_private
from beamsplat.tools.keys.certificates import (
    certificate_as_pem,
    key_as_pem,
    make_host_certificate,
    make_root_certificate,
    new_key,
    read_certificate,
    read_key,
)

CA_KEY = "ca.key"
CA_DAYS = 3650  # validity of the root certificate


class CertificateAuthority:
    """The certificate authority in a folder; `CertificateAuthority.create` makes a new one."""

    def __init__(self, folder: Path) -> None:
        """Open the existing authority in `folder`.

        Raises:
            UserError: the folder contains no authority.
        """
        self.folder = folder.expanduser()
        if not (self.folder / CA_KEY).is_file():
            raise UserError(f"{self.folder} contains no authority: create one with `beamsplat keys init`")

    @staticmethod
    def create(folder: Path, days: int = CA_DAYS) -> CertificateAuthority:
        """Create an authority in a folder; its root certificate is valid for `days` days.

        Raises:
            UserError: the folder contains one already: its certificates would become invalid.
        """
        folder = make_folder(folder.expanduser())
        if (folder / CA_KEY).exists():
            raise UserError(
                f"{folder} contains an authority already, which is never replaced: choose another folder"
            )
        folder.chmod(0o700)
        key = new_key()
        root = make_root_certificate(key, datetime.now(UTC), days)
        write_atomically(folder / CA, certificate_as_pem(root))
        write_atomically(folder / HOSTS, b"")
        write_private(folder / CA_KEY, key_as_pem(key))  # last: with it, the authority is complete
        return CertificateAuthority(folder)

    def issue(self, name: str, host: HostRole, addresses: tuple[str, ...] = (), days: int = 90) -> Path:
        """Create key and certificate of a host, and return the folder to copy to this host.

        An earlier key and certificate of the host are replaced, and the host is added to the policy.

        Args:
            name: name of the host.
            host: role of the host, and the robot it belongs to.
            addresses: DNS names and IP addresses of the host, which are part of the certificate.
            days: validity of the certificate.

        Raises:
            UserError: the host is an edge server without addresses; a name or address is not valid in a
                certificate; the authority's files are damaged.
        """
        if host.role == "edge" and not addresses:
            raise UserError(
                f"{name}: robots check the edge's address against its certificate; set it with --address"
            )
        key = new_key()
        authority = read_certificate(self.folder / CA), read_key(self.folder / CA_KEY)
        certificate = make_host_certificate(name, addresses, key, authority, datetime.now(UTC), days)
        out = make_folder(self.folder / "hosts" / name)
        out.chmod(0o700)
        write_private(out / KEY, key_as_pem(key))
        write_atomically(out / CERTIFICATE, certificate_as_pem(certificate))
        write_atomically(out / CA, (self.folder / CA).read_bytes())
        self._write({**self.hosts(), name: host})
        return out

    def remove(self, name: str) -> None:
        """Remove a host from the policy, so that routers refuse its certificate, and delete its folder.

        Raises:
            UserError: the policy does not contain the host.
        """
        hosts = self.hosts()
        if hosts.pop(name, None) is None:
            raise UserError(f"no host {name!r} in {self.folder / HOSTS}; hosts: {', '.join(hosts) or 'none'}")
        shutil.rmtree(self.folder / "hosts" / name, ignore_errors=True)
        self._write(hosts)

    def hosts(self) -> dict[str, HostRole]:
        """Return the role of every host in the policy, by name of the host."""
        return read_hosts(self.folder)

    def edges(self) -> list[Path]:
        """Return the folders of the edge servers; each contains a copy of the policy."""
        return [self.folder / "hosts" / name for name, host in self.hosts().items() if host.role == "edge"]

    def _write(self, hosts: dict[str, HostRole]) -> None:
        text = "# Written by `beamsplat keys`: which certificate may do what.\n" + "".join(
            f'\n[{name}]\nrole = "{host.role}"\nrobot = "{host.robot}"\n' for name, host in hosts.items()
        )
        write_atomically(self.folder / HOSTS, text.encode())
        for folder in self.edges():
            write_atomically(folder / HOSTS, text.encode())
