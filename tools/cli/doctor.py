"""The command `beamsplat doctor`: find what is missing on this computer, and name the remedy."""

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
from beamsplat.common.engines.choice import cuda_obstacle
from beamsplat.common.optional_packages import remedy_for, requirements

MIN_PYTHON = (3, 11)
MIN_SHM_MB = 256
MIN_DISK_MB = 2000

Verdict = Literal["ok", "note", "fault"]


@dataclass(frozen=True)
class Finding:
    """One result of an examination: subject, verdict, text, and the remedy of a fault."""

    subject: str
    verdict: Verdict
    text: str
    remedy: str = ""


def _python() -> Iterator[Finding]:
    found = ".".join(map(str, sys.version_info[:3]))
    if sys.version_info < MIN_PYTHON:
        yield Finding("Python", "fault", found, "install Python 3.11 or newer, then `make setup`")
    else:
        yield Finding("Python", "ok", f"{found} on {os.cpu_count()} cores")


def _packages() -> Iterator[Finding]:
    """Check the versions of installed packages against the ranges in the metadata of this package."""
    unwanted = ("dev", "all") if _has_nvidia() else ("dev", "all", "gpu")
    for requirement, extra in requirements():
        if requirement.name == "beamsplat" or extra in unwanted:
            continue
        need = f"extra [{extra}]" if extra else "required"
        try:
            version = importlib.metadata.version(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            verdict: Verdict = "note" if extra else "fault"
            remedy = str(remedy_for(requirement.name))
            yield Finding(requirement.name, verdict, f"not installed ({need})", remedy)
            continue
        if requirement.specifier.contains(version, prereleases=True):
            yield Finding(requirement.name, "ok", f"{version} ({need})")
        else:
            wanted = f"{requirement.name}{requirement.specifier}"
            text = f"{version}, needs {requirement.specifier}"
            yield Finding(requirement.name, "fault", text, f"pip install '{wanted}'")


def _has_nvidia() -> bool:
    return shutil.which("nvidia-smi") is not None


def _gpu() -> Iterator[Finding]:
    """Report what computes the map with `mapping.engine = "auto"`: the GPU, or the CPU and why."""
    why = cuda_obstacle()
    if why is None:
        import torch

        name, memory = torch.cuda.get_device_name(0), torch.cuda.get_device_properties(0).total_memory
        architecture = "sm_{}{}".format(*torch.cuda.get_device_capability(0))
        text = f"on the GPU: {name}, {memory / 1e9:.0f} GB, {architecture}; torch {torch.__version__}"
        yield Finding("mapper", "ok", text)
        return
    text = f"on the CPU ({os.cpu_count()} cores): it needs neither a GPU nor torch"
    yield Finding("mapper", "ok", text)
    if _has_nvidia():
        yield Finding("GPU", "note", f"there is one, but the mapper cannot use it: {why}")


def _deployment(deployment: Deployment) -> Iterator[Finding]:
    """Report files that the deployment names and this computer lacks: rig, keys, models, data, classes."""
    from beamsplat.tools.system.assembly import faults, missing_resources

    found = faults(deployment)
    required = [fault for fault in found if "is required" in fault.text]  # to be given with --set
    for fault in found:
        verdict: Verdict = "fault" if fault.fatal and fault not in required else "note"
        yield Finding("deployment", verdict, fault.text, "correct it in the file, or with --set")
    wrong = any(fault.fatal and fault not in required for fault in found)
    named = tuple(n for n in deployment.nodes if not any(f"node {n!r}" in f.text for f in required))
    if wrong:
        return
    missing = missing_resources(deployment, ("router", *named))
    for fault in missing:
        yield Finding("deployment", "fault", fault.text, "correct it in the file, or with --set")
    if deployment.nodes and not found and not missing:
        yield Finding("deployment", "ok", f"{len(deployment.nodes)} nodes; all files they name are there")


def _router(deployment: Deployment) -> Iterator[Finding]:
    from beamsplat.common.errors import UserError
    from beamsplat.common.security.keys import is_loopback
    from beamsplat.common.security.logins import OPERATOR, login_of
    from beamsplat.common.zenoh.bus import open_session

    running = False
    for endpoint in sorted(deployment.router.listen, key=lambda e: not is_loopback(e)):
        if running:  # it listens at the other endpoints too
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
        yield Finding("shared memory", "fault", "/dev/shm is not writable: images are sent more slowly",
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
    from beamsplat.services.depth.model_files import models_dirs

    folders = models_dirs()
    files = {path.name for folder in folders for path in folder.glob("*.onnx")}
    found = sorted(files | {path.parent.name for folder in folders for path in folder.glob("*/model.onnx")})
    where = ", ".join(map(str, folders))
    if found:
        yield Finding("depth networks", "ok", f"{', '.join(found)} in {where}")
    elif os.environ.get("BEAMSPLAT_MODELS"):
        yield Finding("depth networks", "fault", f"no .onnx file in BEAMSPLAT_MODELS={where}",
                      "correct the variable, or unset it")  # fmt: skip
    else:
        yield Finding("depth networks", "note", f"no .onnx file in {where}; source \"stixel\" needs none",
                      "beamsplat models list, beamsplat models pull NAME")  # fmt: skip


def congestion(algorithm: str) -> Finding:
    """Return a finding on whether TCP suits lossy radio links.

    `algorithm` is the congestion control of the kernel, such as "cubic" or "bbr".
    """
    if algorithm == "bbr":
        return Finding("uplink", "ok", "TCP keeps its rate when packets are lost (bbr)")
    return Finding("uplink", "note", f"TCP is {algorithm}: where 1 % is lost, it uses a sixth of 20 Mbit/s",
                   "sysctl -w net.ipv4.tcp_congestion_control=bbr, see docs/deploy.md")  # fmt: skip


def _uplink(deployment: Deployment) -> Iterator[Finding]:
    chosen = Path("/proc/sys/net/ipv4/tcp_congestion_control")
    if deployment.role == "robot" and chosen.exists():
        yield congestion(chosen.read_text().strip())


def _devices(deployment: Deployment) -> Iterator[Finding]:
    from beamsplat.tools.setup.device_access import diagnose_devices, wanted_devices

    for remark in diagnose_devices(wanted_devices(deployment.nodes)):
        yield Finding(remark.subject, remark.verdict, remark.text, remark.remedy)


def examine(deployment: Deployment) -> list[Finding]:
    """Return all findings about this machine and this deployment."""
    checks: tuple[Callable[[], Iterator[Finding]], ...] = (
        _python, _packages, _gpu, lambda: _deployment(deployment), lambda: _router(deployment),
        _shared_memory, lambda: _state(deployment), _models, lambda: _uplink(deployment),
        lambda: _devices(deployment),
    )  # fmt: skip
    return [finding for check in checks for finding in check()]


def doctor(
    file: Annotated[Path | None, typer.Argument(help="Deployment whose port and folders to check")] = None,
    brief: Annotated[bool, typer.Option(help="Show only what is not well")] = False,
    security: Annotated[bool, typer.Option("--security", help="Only links, keys and the policy")] = False,
) -> None:
    """Examine this machine and what a deployment needs of it, and name the remedy for each fault.

    Looks at Python, packages, GPU, the deployment's files (rig, keys, models), the Zenoh port, shared memory,
    disk and devices. Exit code 1 if there is a fault. With --security it explains why a link to another host
    is refused, which Zenoh does not report.

    Examples: beamsplat doctor deploy/demo.toml

    beamsplat doctor deploy/robot.toml --security
    """
    deployment = load_deployment(file) if file else Deployment()
    if security:
        from beamsplat.tools.keys.link_diagnosis import diagnose_security

        findings = [Finding(*remark) for remark in diagnose_security(deployment)]
    else:
        findings = examine(deployment)
    table = Table(pad_edge=False)
    for heading in ("", "what", "found", "remedy"):
        table.add_column(heading, overflow="fold")  # paths must not be truncated
    mark = {"ok": "[green]ok[/]", "note": "[yellow]note[/]", "fault": "[red]FAULT[/]"}
    for finding in findings:
        if not (brief and finding.verdict == "ok"):
            remedy = "" if finding.verdict == "ok" else finding.remedy
            table.add_row(mark[finding.verdict], *map(escape, (finding.subject, finding.text, remedy)))
    Console().print(table)
    if any(finding.verdict == "fault" for finding in findings):
        raise typer.Exit(1)
