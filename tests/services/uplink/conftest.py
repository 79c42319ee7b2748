"""Recordings for tests on two hosts."""

import subprocess
import sys

import pytest

from tests.services.uplink.radio import ROOT, needs_namespaces


@pytest.fixture(scope="session")
def drive(tmp_path_factory):
    """(laps) -> a simulated drive that ends where it started, 70 s per lap."""
    needs_namespaces()
    made = {}

    def make(laps):
        if laps not in made:
            out = tmp_path_factory.mktemp("drives") / f"laps{laps}"
            command = [sys.executable, "-m", "beamsplat", "simulate", "--out", out, "--laps", laps]
            subprocess.run([*map(str, command)], check=True, cwd=ROOT, capture_output=True)
            made[laps] = out / "bag"
        return made[laps]

    return make
