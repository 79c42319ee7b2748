"""Keys of a host for links to other hosts (mutual TLS), and the check that these links are protected.

A host's folder of keys, written by `beamsplat keys`, contains

    ca.pem      certificate of the certificate authority that both sides trust
    host.pem    this host's certificate; its common name (CN) is the host's name
    host.key    its private key, readable by its owner only
    hosts.toml  on an edge server only: the other hosts and their roles (access_control.py)
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path

import zenoh

from beamsplat.common.config.base import Config
from beamsplat.common.errors import UserError

CA, CERTIFICATE, KEY, HOSTS = "ca.pem", "host.pem", "host.key", "hosts.toml"


class SecurityConfig(Config):
    """The [security] table of a deployment."""

    keys: Path | None = None  # the host's folder of keys, required for links to other hosts
    plain: bool = False  # allow unencrypted links to other hosts, for laboratory networks
    local: Path | None = None  # folder of the logins of this host's processes (logins.py); None = no logins


NO_SECURITY = SecurityConfig()


def is_secure(endpoint: str) -> bool:
    """Return whether both sides of a link to this Zenoh endpoint authenticate with certificates."""
    return endpoint.startswith(("tls/", "quic/"))


def is_loopback(endpoint: str) -> bool:
    """Return whether an endpoint ("tcp/127.0.0.1:7447") is unreachable from other hosts."""
    protocol, _, address = endpoint.partition("/")
    host = address.rpartition(":")[0].strip("[]")
    return protocol == "unixsock-stream" or host in ("localhost", "::1") or host.startswith("127.")


@dataclass(frozen=True)
class HostKeys:
    """A complete folder of a host's keys."""

    folder: Path

    @staticmethod
    def of(security: SecurityConfig) -> HostKeys:
        """Return the keys in the folder `security.keys`, after checking its files.

        Raises:
            UserError: no folder is configured, a file is missing, or others can read the private key.
        """
        if security.keys is None:
            raise UserError(
                "security.keys: a link to another host needs the host's keys: create them with "
                "`beamsplat keys init` and `beamsplat keys issue`, then set keys = FOLDER under [security]"
            )
        folder = security.keys.expanduser()
        for name in (CA, CERTIFICATE, KEY):
            if not (folder / name).is_file():
                raise UserError(
                    f"security.keys = {folder}: {name} is missing; create it with `beamsplat keys issue`"
                )
        mode = (folder / KEY).stat().st_mode & 0o777
        if mode & 0o077:
            raise UserError(
                f"{folder / KEY} can be read by others (mode {mode:03o}): chmod 600, or issue a new one"
            )
        return HostKeys(folder)

    def identify(self, config: zenoh.Config) -> None:
        """Configure a Zenoh session to authenticate with this certificate and to require the peer's."""
        certificate, key = str(self.folder / CERTIFICATE), str(self.folder / KEY)
        config.insert_json5("transport/link/tls", json.dumps({
            "enable_mtls": True, "root_ca_certificate": str(self.folder / CA),
            "listen_certificate": certificate, "listen_private_key": key,
            "connect_certificate": certificate, "connect_private_key": key,
            "verify_name_on_connect": True, "close_link_on_expiration": True,
        }))  # fmt: skip


def check_endpoint(endpoint: str, security: SecurityConfig) -> None:
    """Check that an endpoint is local, or authenticated, or that `security.plain` allows plain links.

    Raises:
        UserError: the link would leave this host without certificates.
    """
    if not (is_loopback(endpoint) or security.plain or is_secure(endpoint)):
        raise UserError(
            f"{endpoint} leaves this host unprotected: use tls/ and `beamsplat keys`, or set "
            "security.plain = true in a network that you trust"
        )


def write_private(path: Path, data: bytes) -> None:
    """Replace a file by a new file that is created with mode 600: other users can never read the data.

    Raises:
        OSError: the file cannot be written.
    """
    fresh = path.with_name(f".{path.name}")
    fresh.unlink(missing_ok=True)
    with os.fdopen(os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    fresh.replace(path)
