"""Who a host is on a link to another: its certificate, and what a router lets whom do.

A host's folder of keys holds

    ca.pem      the authority that both sides trust
    host.pem    this host's certificate; its name (CN) is the host's
    host.key    its private key, readable by its owner only
    hosts.toml  on an edge server: which hosts there are, and what each may do (`beamsplat keys` writes it)
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import zenoh

from beamsplat.common.config.base import Config
from beamsplat.common.errors import UserError

CA, CERTIFICATE, KEY, HOSTS = "ca.pem", "host.pem", "host.key", "hosts.toml"


class SecurityConfig(Config):
    """`keys` is the host's folder of keys; `plain` allows links off this host without, for laboratories.
    `local` is a folder for logins of this host's own processes (common/credentials.py)."""

    keys: Path | None = None
    plain: bool = False
    local: Path | None = None


OPEN = SecurityConfig()


def is_secure(endpoint: str) -> bool:
    """Whether both sides of such a link show certificates."""
    return endpoint.startswith(("tls/", "quic/"))


def is_loopback(endpoint: str) -> bool:
    """Whether an endpoint ("tcp/127.0.0.1:7447") cannot be reached from another host."""
    protocol, _, address = endpoint.partition("/")
    host = address.rpartition(":")[0].strip("[]")
    return protocol == "unixsock-stream" or host in ("localhost", "::1") or host.startswith("127.")


@dataclass(frozen=True)
class Keys:
    """A host's folder of keys, found to be complete."""

    folder: Path

    @staticmethod
    def of(security: SecurityConfig) -> Keys:
        """The keys a deployment names.

        Raises:
            UserError: none are named, or a file is missing or readable by others.
        """
        if security.keys is None:
            raise UserError(
                "security.keys: a link off this host needs the host's keys: `beamsplat keys init` and "
                "`beamsplat keys issue` make them; name their folder under [security]"
            )
        folder = security.keys.expanduser()
        for name in (CA, CERTIFICATE, KEY):
            if not (folder / name).is_file():
                raise UserError(
                    f"security.keys = {folder}: {name} is missing; `beamsplat keys issue` makes it"
                )
        mode = (folder / KEY).stat().st_mode & 0o777
        if mode & 0o077:
            raise UserError(
                f"{folder / KEY} can be read by others (mode {mode:03o}): chmod 600, or issue a new one"
            )
        return Keys(folder)

    def identify(self, config: zenoh.Config) -> None:
        """Lets a session show its certificate on both kinds of link, and ask the other for its own."""
        certificate, key = str(self.folder / CERTIFICATE), str(self.folder / KEY)
        config.insert_json5("transport/link/tls", json.dumps({
            "enable_mtls": True, "root_ca_certificate": str(self.folder / CA),
            "listen_certificate": certificate, "listen_private_key": key,
            "connect_certificate": certificate, "connect_private_key": key,
            "verify_name_on_connect": True, "close_link_on_expiration": True,
        }))  # fmt: skip


def check_endpoint(endpoint: str, security: SecurityConfig) -> None:
    """Raises UserError for a link off this host without certificates, unless that is asked for."""
    if not (is_loopback(endpoint) or security.plain or is_secure(endpoint)):
        raise UserError(
            f"{endpoint} leaves this host unprotected: use tls/ and `beamsplat keys`, or allow it with "
            "security.plain = true in a network that you trust"
        )
