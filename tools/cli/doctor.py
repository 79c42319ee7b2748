"""`beamsplat doctor`: what this machine lacks, and the remedy for each fault."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import shutil
import socket
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from beamsplat.common.config.deployment import Deployment, load_deployment

MIN_PYTHON = (3, 11)
MIN_SHM_MB = 256
MIN_DISK_MB = 2000


@dataclass(frozen=True)
class Finding:
    """One line of the report."""

    subject: str
    verdict: Literal["ok", "note", "fault"]
    text: str
    remedy: str = ""


def _python() -> Iterator[Finding]:
    found = ".".join(map(str, sys.version_info[:3]))
    if sys.version_info < MIN_PYTHON:
        yield Finding("Python", "fault", found, "install Python 3.11 or newer, then `make setup`")
    else:
        yield Finding("Python", "ok", f"{found} on {os.cpu_count()} cores")


def _packages() -> Iterator[Finding]:
    """Installed versions against the ranges in this package's own metadata."""
    from packaging.requirements import Requirement

    for line in importlib.metadata.requires("beamsplat") or ():
        requirement = Requirement(line)
        extra = str(requirement.marker or "").partition("extra == ")[2].strip("\"'")
        unwanted = ("dev", "all") if _has_nvidia() else ("dev", "all", "gpu")
        if requirement.name == "beamsplat" or extra in unwanted:
            continue
        need = f"extra [{extra}]" if extra else "required"
        try:
            version = importlib.metadata.version(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            target = f"beamsplat[{extra}]" if extra else "beamsplat"
            verdict = "note" if extra else "fault"
            yield Finding(requirement.name, verdict, f"not installed ({need})", f"pip install '{target}'")
            continue
        if requirement.specifier.contains(version, prereleases=True):
            yield Finding(requirement.name, "ok", f"{version} ({need})")
        else:
            wanted = str(requirement.specifier)
            yield Finding(
                requirement.name, "fault", f"{version}, needs {wanted}", f"pip install '{requirement}'"
            )


def _has_nvidia() -> bool:
    return shutil.which("nvidia-smi") is not None


def _gpu() -> Iterator[Finding]:
    if importlib.util.find_spec("torch") is None:
        yield Finding(
            "GPU", "note", "torch is not installed: no mapping here", "pip install 'beamsplat[edge]'"
        )
        return
    import torch

    if torch.cuda.is_available():
        memory_gb = torch.cuda.get_device_properties(0).total_memory / 1e9
        yield Finding("GPU", "ok", f"{torch.cuda.get_device_name(0)}, {memory_gb:.0f} GB")
        if importlib.util.find_spec("gsplat") is None:
            yield Finding("gsplat", "note", "not installed: GPU is idle", "pip install 'beamsplat[gpu]'")
    elif _has_nvidia():
        yield Finding(
            "GPU", "fault", f"there is a GPU, but torch {torch.__version__} is built without CUDA",
            "pip install --force-reinstall torch, then 'beamsplat[gpu]'",
        )  # fmt: skip
    else:
        yield Finding("GPU", "ok", "none: the CPU mapper will be used")


def _router(deployment: Deployment) -> Iterator[Finding]:
    from beamsplat.common.errors import UserError
    from beamsplat.common.security.keys import is_loopback
    from beamsplat.common.security.logins import OPERATOR, login_of
    from beamsplat.common.zenoh.bus import open_session

    running = False
    for endpoint in sorted(deployment.router.listen, key=lambda e: not is_loopback(e)):
        if running:  # whose other doors are open, too
            continue
        try:
            login = login_of(deployment.security, OPERATOR)
            open_session((endpoint,), wait_s=0.0, login=login).close()
        except UserError:
            pass
        else:
            running = True
            yield Finding("Zenoh router", "ok", f"one is running at {endpoint}")
            continue
        host, _, port = endpoint.rpartition("/")[2].rpartition(":")
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host.strip("[]"), int(port)))
            except (OSError, ValueError) as error:
                yield Finding(
                    "Zenoh router", "fault", f"{endpoint} cannot be listened on: {error}",
                    "another program has the port: `ss -ltnp` names it; or change router.listen",
                )  # fmt: skip
            else:
                yield Finding("Zenoh router", "ok", f"{endpoint} is free")


def _shared_memory() -> Iterator[Finding]:
    shm = Path("/dev/shm")
    if not shm.is_dir() or not os.access(shm, os.W_OK):
        yield Finding("shared memory", "fault", "/dev/shm is not writable: pictures go the slow way",
                      "mount -t tmpfs tmpfs /dev/shm, or give the container --shm-size=512m")  # fmt: skip
        return
    free_mb = shutil.disk_usage(shm).free / 1e6
    if free_mb < MIN_SHM_MB:
        yield Finding("shared memory", "fault", f"{free_mb:.0f} MB free in /dev/shm, {MIN_SHM_MB} are needed",
                      "give the container --shm-size=512m, or remove stale files in /dev/shm")  # fmt: skip
    else:
        yield Finding("shared memory", "ok", f"{free_mb:.0f} MB free in /dev/shm")


def _state(deployment: Deployment) -> Iterator[Finding]:
    folder = deployment.run_dir
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        yield Finding("state folder", "fault", f"{folder}: {error.strerror}",
                      "choose another with state_dir in the deployment file")  # fmt: skip
        return
    free_mb = shutil.disk_usage(folder).free / 1e6
    if free_mb < MIN_DISK_MB:
        yield Finding("state folder", "fault", f"{free_mb:.0f} MB free at {folder}", "free some disk space")
    else:
        yield Finding("state folder", "ok", f"{folder}, {free_mb / 1e3:.0f} GB free")


def _models() -> Iterator[Finding]:
    folder = os.environ.get("BEAMSPLAT_MODELS", "")
    if not folder:
        yield Finding("depth networks", "note", "BEAMSPLAT_MODELS is not set: no networks",
                      "export BEAMSPLAT_MODELS=folder with .onnx files")  # fmt: skip
        return
    found = sorted(path.name for path in Path(folder).glob("*.onnx"))
    if found:
        yield Finding("depth networks", "ok", f"{', '.join(found)} in {folder}")
    else:
        yield Finding("depth networks", "fault", f"no .onnx file in BEAMSPLAT_MODELS={folder}",
                      "correct the variable, or unset it")  # fmt: skip


def congestion(algorithm: str) -> Finding:
    """What this host's TCP does on a radio that loses packets; `algorithm` as the kernel names it."""
    if algorithm == "bbr":
        return Finding("uplink", "ok", "TCP takes lost packets for what they are (bbr)")
    return Finding("uplink", "note", f"TCP is {algorithm}: where 1 % is lost, it uses a sixth of 20 Mbit/s",
                   "sysctl -w net.ipv4.tcp_congestion_control=bbr, see docs/deploy.md")  # fmt: skip


def _uplink(deployment: Deployment) -> Iterator[Finding]:
    chosen = Path("/proc/sys/net/ipv4/tcp_congestion_control")
    if deployment.role == "robot" and chosen.exists():
        yield congestion(chosen.read_text().strip())


def _devices(deployment: Deployment) -> Iterator[Finding]:
    from beamsplat.tools.setup.device_access import examine_devices, wanted_devices

    for remark in examine_devices(wanted_devices(deployment.nodes)):
        yield Finding(*remark)


def examine(deployment: Deployment) -> list[Finding]:
    """All findings about this machine and this deployment."""
    checks: tuple[Callable[[], Iterator[Finding]], ...] = (
        _python, _packages, _gpu, lambda: _router(deployment), _shared_memory, lambda: _state(deployment),
        _models, lambda: _uplink(deployment), lambda: _devices(deployment),
    )  # fmt: skip
    return [finding for check in checks for finding in check()]


def doctor(
    file: Annotated[Path | None, typer.Argument(help="Deployment whose port and folders to check")] = None,
    brief: Annotated[bool, typer.Option(help="Show only what is not well")] = False,
    security: Annotated[bool, typer.Option("--security", help="Only links, keys and the policy")] = False,
) -> None:
    """Examines this machine: Python, packages, GPU, Zenoh port, shared memory, disk, models, devices.

    Exit code 1 if there is a fault. With --security it says why a link to another host is refused, which
    Zenoh passes over in silence.

    Examples: beamsplat doctor deploy/demo.toml

    beamsplat doctor deploy/robot.toml --security
    """
    deployment = load_deployment(file) if file else Deployment()
    if security:
        from beamsplat.tools.keys.link_diagnosis import examine_security

        findings = [Finding(*remark) for remark in examine_security(deployment)]
    else:
        findings = examine(deployment)
    table = Table(pad_edge=False)
    for heading in ("", "what", "found", "remedy"):
        table.add_column(heading, overflow="fold")  # a path that is cut helps nobody
    mark = {"ok": "[green]ok[/]", "note": "[yellow]note[/]", "fault": "[red]FAULT[/]"}
    for finding in findings:
        if not (brief and finding.verdict == "ok"):
            remedy = "" if finding.verdict == "ok" else finding.remedy
            table.add_row(mark[finding.verdict], *map(escape, (finding.subject, finding.text, remedy)))
    Console().print(table)
    if any(finding.verdict == "fault" for finding in findings):
        raise typer.Exit(1)
