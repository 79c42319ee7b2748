"""What stands in the way of a protected link, said aloud: Zenoh passes over every refusal in silence."""

from __future__ import annotations

import shutil
import socket
import ssl
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from beamsplat.common.config.deployment import Deployment
from beamsplat.common.errors import UserError
from beamsplat.common.security.access_control import read_hosts
from beamsplat.common.security.keys import (
    CA,
    CERTIFICATE,
    KEY,
    HostKeys,
    check_endpoint,
    is_loopback,
    is_secure,
)
from beamsplat.tools.keys.pki import expiry, openssl

SOON_DAYS = 14
_PATIENCE_S = 3.0
Remark = tuple[str, Literal["ok", "note", "fault"], str, str]  # subject, verdict, what was found, remedy
_RENEW = "renew it: beamsplat keys issue NAME, where the authority is, and copy the folder here"


def examine_security(deployment: Deployment) -> Iterator[Remark]:
    """Endpoints, keys, policy, and for a robot the way to its edge, step by step."""
    uplink = str(deployment.nodes.get("uplink", {}).get("edge", ""))
    endpoints = [*deployment.router.listen, *deployment.router.connect, *([uplink] if uplink else [])]
    for endpoint in endpoints:
        try:
            check_endpoint(endpoint, deployment.security)
        except UserError as error:
            yield "link", "fault", str(error), "beamsplat keys init, issue; name the folder in security.keys"
        else:
            yield _protection(endpoint)
    if not any(is_secure(endpoint) for endpoint in endpoints):
        return
    try:
        keys = HostKeys.of(deployment.security)
    except UserError as error:
        yield "keys", "fault", str(error), "beamsplat keys issue NAME, then copy the folder it names"
        return
    yield from _certificate(keys.folder)
    if any(is_secure(endpoint) for endpoint in deployment.router.listen):
        yield from _policy(keys.folder)
    if is_secure(uplink):
        yield from _way_to(uplink, keys.folder)


def _protection(endpoint: str) -> Remark:
    if is_secure(endpoint):
        return "link", "ok", f"{endpoint}: both sides show certificates", ""
    if is_loopback(endpoint):
        return "link", "ok", f"{endpoint}: processes of this host only", ""
    return (
        "link",
        "note",
        f"{endpoint}: open to everybody who reaches it (security.plain)",
        "use tls/ instead",
    )


def _certificate(folder: Path) -> Iterator[Remark]:
    if shutil.which("openssl") is None:
        yield "certificate", "note", "not examined: `openssl` is not installed", "apt install openssl"
        return
    file = folder / CERTIFICATE
    try:
        text = openssl("x509", "-in", str(file), "-noout", "-subject", "-nameopt", "multiline")
        until = datetime.strptime(expiry(file), "%b %d %H:%M:%S %Y %Z").replace(tzinfo=UTC)
    except (UserError, ValueError) as error:
        yield "certificate", "fault", f"{file} cannot be read: {error}", _RENEW
        return
    name = next((line.rpartition("= ")[2] for line in text.splitlines() if "commonName" in line), "nobody")
    days = (until - datetime.now(UTC)).total_seconds() / 86400
    if days < 0:
        yield "certificate", "fault", f"{name}: expired on {until:%Y-%m-%d}; is the clock right?", _RENEW
    elif days < SOON_DAYS:
        yield "certificate", "note", f"{name}: expires in {days:.0f} days", _RENEW
    else:
        yield "certificate", "ok", f"{name}: valid for {days:.0f} days", ""
    try:
        openssl("verify", "-no_check_time", "-CAfile", str(folder / CA), str(file))
    except UserError:
        yield "certificate", "fault", f"{file} was not issued by {folder / CA}", _RENEW


def _policy(folder: Path) -> Iterator[Remark]:
    try:
        hosts = read_hosts(folder)
    except UserError as error:
        yield "policy", "fault", str(error), "copy hosts.toml from the authority's hosts folder"
        return
    robots = {name: host.robot for name, host in hosts.items() if host.role == "robot"}
    for name, host in hosts.items():
        yield (
            "policy",
            "ok",
            f"{name}: {host.role} of {'all robots' if host.robot == '*' else host.robot}",
            "",
        )
    if not robots:
        yield "policy", "note", "no robot may connect", "beamsplat keys issue robot1"


def _way_to(endpoint: str, folder: Path) -> Iterator[Remark]:
    """Name, TCP, TLS: the first that fails is the reason."""
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    host = host.strip("[]")
    context = ssl.create_default_context(ssl.Purpose.SERVER_AUTH, cafile=str(folder / CA))
    try:
        context.load_cert_chain(folder / CERTIFICATE, folder / KEY)
        with (
            socket.create_connection((host, int(port)), _PATIENCE_S) as raw,
            context.wrap_socket(raw, server_hostname=host) as link,
        ):
            link.settimeout(1.0)
            # Whether the other side takes our certificate shows only when it would speak: silence is assent.
            if link.recv(1) == b"":
                raise ssl.SSLError("the edge closes the link: it does not take this host's certificate")
    except TimeoutError as error:
        if "handshake" in str(error) or not str(error).startswith("The read"):
            yield "edge", "fault", f"{endpoint} does not answer", "is the edge running and reachable? ping it"
        else:
            yield "edge", "ok", f"{endpoint} takes this host's certificate, and shows a good one", ""
    except socket.gaierror as error:
        yield (
            "edge",
            "fault",
            f"{host} is no known name ({error.strerror})",
            "name its address in uplink.edge",
        )
    except ssl.SSLCertVerificationError as error:
        yield (
            "edge",
            "fault",
            f"the edge's certificate is not good: {error.verify_message}",
            ("issue the edge's anew: beamsplat keys issue edge --role edge --address " + host),
        )
    except ssl.SSLError as error:
        reason = (error.reason or str(error)).replace("_", " ").lower()
        yield "edge", "fault", f"the edge refuses this host's certificate: {reason}", _RENEW
    except OSError as error:
        yield (
            "edge",
            "fault",
            f"{endpoint} cannot be reached: {error.strerror or error}",
            "is the edge running?",
        )
    yield (
        "edge",
        "note",
        "whether this host is in the edge's policy, only the edge can tell",
        ("there: beamsplat doctor deploy/edge.toml --security"),
    )
