"""Collect the contents of a bug report: versions, deployment, logs, findings, health; without secrets."""

from __future__ import annotations

import importlib.metadata
import io
import json
import os
import platform
import shutil
import subprocess
import zipfile
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import psutil

from beamsplat.common.config.deployment import Deployment
from beamsplat.common.errors import UserError, reason
from beamsplat.common.optional_packages import requirements
from beamsplat.common.redaction import Redactor
from beamsplat.tools.system.log_tail import log_tail

LOG_BYTES = 200_000  # of the end of each log
HEALTH_S = 2.5  # nodes report once per second, and a rate needs two reports


def versions() -> dict[str, Any]:
    """Return versions (this package, Python, dependencies) and properties of this host, by name.

    The properties are platform, CPU cores, memory in MB, and GPUs.
    """
    packages: dict[str, str | None] = {}
    for requirement, _ in requirements():
        try:
            packages[requirement.name] = importlib.metadata.version(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            packages[requirement.name] = None
    return {
        "beamsplat": importlib.metadata.version("beamsplat"), "python": platform.python_version(),
        "platform": platform.platform(), "machine": platform.machine(), "cpu_cores": os.cpu_count(),
        "memory_mb": round(psutil.virtual_memory().total / 1e6), "gpu": _gpus(), "packages": packages,
    }  # fmt: skip


def _gpus() -> list[str]:
    if shutil.which("nvidia-smi") is None:
        return []
    command = ["nvidia-smi", "--query-gpu=name,driver_version,memory.total", "--format=csv,noheader"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    return done.stdout.strip().splitlines()


def bundle(
    deployment: Deployment,
    findings: Callable[[], Iterable[Any]],
    health: Callable[[], dict[str, Any]],
) -> bytes:
    """Return a ZIP file with versions, deployment, findings, health and the ends of the logs.

    Secrets are removed. A part that cannot be collected is replaced by the reason.

    Args:
        findings: returns the findings of `beamsplat doctor` (dataclasses).
        health: returns `HealthTable.snapshot()` of the running system; raises UserError if none runs.
    """
    redactor = Redactor()
    options = redactor.table(deployment.model_dump(mode="json"))
    parts: dict[str, str] = {
        "versions.json": _json(versions),
        "deployment.json": json.dumps(options, indent=1),
        "doctor.json": _json(lambda: [asdict(finding) for finding in findings()]),
        "health.json": _json(health),
    }
    for log in sorted((deployment.run_dir / "logs").glob("*.log")):
        parts[f"logs/{log.name}"] = _tail(log)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as file:
        for name, text in parts.items():
            file.writestr(name, redactor.text(text))
    return out.getvalue()


def _json(collect: Callable[[], Any]) -> str:
    try:
        return json.dumps(collect(), indent=1, default=str)
    except (UserError, OSError, subprocess.SubprocessError) as error:
        return json.dumps({"error": reason(error)})


def _tail(path: Path) -> str:
    try:
        return log_tail(path, LOG_BYTES)
    except OSError as error:
        return f"not readable: {reason(error)}"
