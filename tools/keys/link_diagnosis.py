"""Diagnose why a TLS link is not opened: Zenoh does not report the reason of a refusal."""

from __future__ import annotations

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
from beamsplat.tools.keys.certificates import common_name, is_issued_by, read_certificate

EXPIRES_SOON_DAYS = 14  # before the expiry of a certificate, a note is given
_TIMEOUT_S = 3.0  # to connect to the edge
LinkFinding = tuple[str, Literal["ok", "note", "fault"], str, str]  # subject, verdict, finding, remedy
_RENEW = "renew it: run `beamsplat keys issue NAME` on the authority's host, and copy the folder here"


def diagnose_security(deployment: Deployment) -> Iterator[LinkFinding]:
    """Yield findings on the links of a deployment to other hosts: endpoints, keys, certificate, policy.

    On a robot, the connection to its edge server is tested too: name resolution, TCP, TLS.
    """
    uplink = str(deployment.nodes.get("uplink", {}).get("edge", ""))
    endpoints = [*deployment.router.listen, *deployment.router.connect, *([uplink] if uplink else [])]
    for endpoint in endpoints:
        try:
            check_endpoint(endpoint, deployment.security)
        except UserError as error:
            yield (
                "link",
                "fault",
                str(error),
                "run `beamsplat keys init` and `issue`; set security.keys to the folder",
            )
        else:
            yield _endpoint_finding(endpoint)
    if not any(is_secure(endpoint) for endpoint in endpoints):
        return
    try:
        keys = HostKeys.of(deployment.security)
    except UserError as error:
        yield (
            "keys",
            "fault",
            str(error),
            "run `beamsplat keys issue NAME`, then copy the folder that it prints",
        )
        return
    yield from _check_certificate(keys.folder)
    if any(is_secure(endpoint) for endpoint in deployment.router.listen):
        yield from _check_policy(keys.folder)
    if is_secure(uplink):
        yield from _check_tls_connection(uplink, keys.folder)


def _endpoint_finding(endpoint: str) -> LinkFinding:
    if is_secure(endpoint):
        return "link", "ok", f"{endpoint}: TLS, both sides present certificates", ""
    if is_loopback(endpoint):
        return "link", "ok", f"{endpoint}: processes of this host only", ""
    return (
        "link",
        "note",
        f"{endpoint}: not protected, anyone who can reach it may connect (security.plain)",
        "use tls/ instead",
    )


def _check_certificate(folder: Path) -> Iterator[LinkFinding]:
    file = folder / CERTIFICATE
    try:
        certificate, authority = read_certificate(file), read_certificate(folder / CA)
    except UserError as error:
        yield "certificate", "fault", str(error), _RENEW
        return
    name, until = common_name(certificate), certificate.not_valid_after_utc
    days = (until - datetime.now(UTC)).total_seconds() / 86400
    if days < 0:
        yield (
            "certificate",
            "fault",
            f"{name}: expired on {until:%Y-%m-%d}; check the clock of this host",
            _RENEW,
        )
    elif days < EXPIRES_SOON_DAYS:
        yield "certificate", "note", f"{name}: expires in {days:.0f} days", _RENEW
    else:
        yield "certificate", "ok", f"{name}: valid for {days:.0f} days", ""
    if not is_issued_by(certificate, authority):
        yield "certificate", "fault", f"{file} was not issued by {folder / CA}", _RENEW


def _check_policy(folder: Path) -> Iterator[LinkFinding]:
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


def _check_tls_connection(endpoint: str, folder: Path) -> Iterator[LinkFinding]:
    """Test name resolution, TCP and TLS to an edge server; yield a finding on the first step that fails.

    `folder` contains the keys of this host.
    """
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    host = host.strip("[]")
    context = ssl.create_default_context(ssl.Purpose.SERVER_AUTH, cafile=str(folder / CA))
    try:
        context.load_cert_chain(folder / CERTIFICATE, folder / KEY)
        with (
            socket.create_connection((host, int(port)), _TIMEOUT_S) as raw,
            context.wrap_socket(raw, server_hostname=host) as link,
        ):
            link.settimeout(1.0)
            # TLS 1.3 reports a rejected client certificate only at the first read: a timeout means accepted.
            if link.recv(1) == b"":
                raise ssl.SSLError("the edge closes the link: it does not accept this host's certificate")
    except TimeoutError as error:
        if "handshake" in str(error) or not str(error).startswith("The read"):
            yield (
                "edge",
                "fault",
                f"{endpoint} does not answer",
                "check that the edge is running and reachable (ping)",
            )
        else:
            yield "edge", "ok", f"{endpoint} accepts this host's certificate, and its own is valid", ""
    except socket.gaierror as error:
        yield (
            "edge",
            "fault",
            f"{host} cannot be resolved ({error.strerror})",
            "set uplink.edge to its IP address",
        )
    except ssl.SSLCertVerificationError as error:
        yield (
            "edge",
            "fault",
            f"the edge's certificate is not valid: {error.verify_message}",
            ("issue a new one: beamsplat keys issue edge --role edge --address " + host),
        )
    except ssl.SSLError as error:
        reason = (error.reason or str(error)).replace("_", " ").lower()
        yield "edge", "fault", f"the edge rejects this host's certificate: {reason}", _RENEW
    except OSError as error:
        yield (
            "edge",
            "fault",
            f"{endpoint} cannot be reached: {error.strerror or error}",
            "check that the edge is running",
        )
    yield (
        "edge",
        "note",
        "whether the edge's policy contains this host can be checked only on the edge",
        ("run there: beamsplat doctor deploy/edge.toml --security"),
    )
