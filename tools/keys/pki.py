"""Manage the certificate authority of a fleet: its key, the certificates of hosts, and their access rights.

Files in the folder of the authority:

    ca.key      private key of the authority; stays in this folder
    ca.pem      root certificate that all hosts trust
    hosts.toml  the policy: every host that was issued and not removed; each edge has a copy
    hosts/NAME  to be copied to that host: ca.pem, host.pem, host.key (and hosts.toml for an edge)

Keys and certificates are made with OpenSSL's command line, which only the authority's host needs.
"""

from __future__ import annotations

import ipaddress
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from beamsplat.common.errors import UserError
from beamsplat.common.files.persist import make_folder, write_atomically
from beamsplat.common.security.access_control import HostRole, read_hosts
from beamsplat.common.security.keys import CA, CERTIFICATE, HOSTS, KEY

CA_KEY = "ca.key"
CA_DAYS = 3650  # validity of the root certificate


def openssl(*arguments: str) -> str:
    """Run `openssl` with these arguments and return its standard output.

    Raises:
        UserError: OpenSSL is not installed, or the command fails.
    """
    if shutil.which("openssl") is None:
        raise UserError("the command `openssl` is not installed: apt install openssl")
    done = subprocess.run(["openssl", *arguments], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        lines = [line for line in done.stderr.strip().splitlines() if line] or ["no reason given"]
        raise UserError(f"openssl {arguments[0]} failed: {lines[-1]}")
    return done.stdout


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
            UserError: the folder contains one already (its certificates would become invalid), or OpenSSL
            fails.
        """
        folder = make_folder(folder.expanduser())
        if (folder / CA_KEY).exists():
            raise UserError(
                f"{folder} contains an authority already, which is never replaced: choose another folder"
            )
        folder.chmod(0o700)
        _new_key(folder / CA_KEY)
        openssl("req", "-x509", "-new", "-key", str(folder / CA_KEY), "-sha256", "-days", str(days),
                "-subj", "/O=BeamSplat/CN=BeamSplat authority", "-out", str(folder / CA),
                "-addext", "basicConstraints=critical,CA:TRUE,pathlen:0",
                "-addext", "keyUsage=critical,keyCertSign,cRLSign")  # fmt: skip
        write_atomically(folder / HOSTS, b"")
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
            UserError: the host is an edge server without addresses, or OpenSSL fails.
        """
        if host.role == "edge" and not addresses:
            raise UserError(
                f"{name}: robots check the edge's address against its certificate; set it with --address"
            )
        out = make_folder(self.folder / "hosts" / name)
        out.chmod(0o700)
        with tempfile.TemporaryDirectory(dir=self.folder) as scratch:
            request, extensions = Path(scratch, "request"), Path(scratch, "extensions")
            _new_key(Path(scratch, KEY))
            openssl("req", "-new", "-key", str(Path(scratch, KEY)), "-subj", f"/O=BeamSplat/CN={name}",
                    "-out", str(request))  # fmt: skip
            extensions.write_text(_extensions((name, *addresses)))
            openssl("x509", "-req", "-in", str(request), "-CA", str(self.folder / CA), "-CAkey",
                    str(self.folder / CA_KEY), "-CAcreateserial", "-sha256", "-days", str(days),
                    "-extfile", str(extensions), "-out", str(Path(scratch, CERTIFICATE)))  # fmt: skip
            for file in (KEY, CERTIFICATE):
                Path(scratch, file).replace(out / file)
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


def expiry(certificate: Path) -> str:
    """Return the expiry date of a certificate file in OpenSSL's format, such as Jan  2 15:04:05 2027 GMT."""
    return openssl("x509", "-in", str(certificate), "-noout", "-enddate").strip().partition("=")[2]


def _new_key(path: Path) -> None:
    path.touch(mode=0o600)
    openssl("ecparam", "-name", "prime256v1", "-genkey", "-noout", "-out", str(path))
    os.chmod(path, 0o600)


def _extensions(addresses: tuple[str, ...]) -> str:
    return (
        "basicConstraints=critical,CA:FALSE\n"
        "keyUsage=critical,digitalSignature\n"
        "extendedKeyUsage=serverAuth,clientAuth\n"
        "subjectAltName=" + ",".join(_subject_alternative_name(a) for a in dict.fromkeys(addresses)) + "\n"
    )


def _subject_alternative_name(address: str) -> str:
    try:
        return f"IP:{ipaddress.ip_address(address)}"
    except ValueError:
        return f"DNS:{address}"
