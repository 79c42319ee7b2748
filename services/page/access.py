"""Access control of the page: the token for commands, and the host names by which browsers may address it."""

from __future__ import annotations

import hmac
import ipaddress
import socket
from dataclasses import dataclass, field


def own_host_names() -> frozenset[str]:
    """Return the host names by which browsers may address this machine."""
    host = socket.gethostname().lower()
    return frozenset({"localhost", host, f"{host}.local", socket.getfqdn().lower()})


@dataclass(frozen=True)
class PageAccess:
    """Token for commands, and accepted host names besides IP addresses."""

    token: str = ""  # for commands; "": commands are disabled
    names: frozenset[str] = field(default_factory=own_host_names)  # in lower case

    def is_token(self, given: str) -> bool:
        """Return whether a string is the token, in a time that does not depend on the string."""
        return hmac.compare_digest(given.encode(), self.token.encode())

    def is_own_host(self, host: str) -> bool:
        """Return whether a Host header names this machine: an IP address or one of `names`.

        A foreign page can let its own host name refer to this machine (DNS rebinding) to read the data of
        this server. The browser then sends that foreign name in the Host header: the page cannot change it.
        """
        name = _name_of(host)
        if name in self.names:
            return True
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return True

    def is_own_origin(self, origin: str, host: str) -> bool:
        """Return whether an Origin header belongs to a page of this server, which was addressed as `host`.

        A name of `names` is accepted too: a reverse proxy may replace the Host header.
        """
        authority = origin.partition("://")[2].lower()
        return authority == host.strip().lower() or _name_of(authority) in self.names


def page_address(bind: str, port: int, scheme: str = "http") -> str:
    """Return the address of a page that listens at `bind`, for a browser on this machine."""
    host = "127.0.0.1" if bind in ("0.0.0.0", "::") else bind
    return f"{scheme}://{f'[{host}]' if ':' in host else host}:{port}/"


def _name_of(host: str) -> str:
    """Return the name or address in a Host header, without port and brackets."""
    name = host.strip().lower()
    if name.startswith("["):
        return name[1:].partition("]")[0]
    return name.partition(":")[0] if name.count(":") <= 1 else name
