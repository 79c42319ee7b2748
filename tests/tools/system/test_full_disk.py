"""A full or read-only disk stops no start and no restart, and writing resumes when it has room again."""

import os
import signal

import pytest

from beamsplat.common.config.deployment import Deployment, RouterConfig
from beamsplat.common.recording import RecordingReader
from beamsplat.common.security.keys import SecurityConfig
from beamsplat.common.security.logins import OPERATOR, login_of
from beamsplat.common.zenoh.bus import open_session
from beamsplat.tools.system.health_table import HealthTable
from beamsplat.tools.system.supervisor import Supervisor
from tests.common.files.small_disk import SmallDisk
from tests.common.polling import wait_until


@pytest.fixture
def disk(tmp_path):
    disk = SmallDisk(tmp_path / "disk", 40)
    yield disk
    disk.close()


def run(deployment, while_running):
    """Run a deployment; call `while_running(supervisor, table)` with the table of all health reports."""
    with Supervisor(deployment) as supervisor:
        login = login_of(deployment.security, OPERATOR)
        with open_session(deployment.router.listen, login=login) as session:
            while_running(supervisor, HealthTable(session, deployment.robot))


def detail(table, name):
    return table.records[name].health.detail


@pytest.mark.parametrize("fault", ["full", "read-only"])
def test_all_nodes_start_and_restart_without_a_disk_and_write_when_it_is_back(disk, free_endpoint, fault):
    path = disk.path
    deployment = Deployment(
        robot="t",
        router=RouterConfig(listen=(free_endpoint,)),
        state_dir=path / "state",
        security=SecurityConfig(local=path / "logins"),
        nodes={
            "clock": {},
            "recorder": {"out": str(path / "new" / "rec"), "chunk_s": 0.0},
            "keyframes": {"durable": True},
            "localization": {"kind": "lidar", "save": str(path / "new" / "lidar")},
            "monitor": {"view": "none", "save": str(path / "new" / "drive.rrd")},
        },
    )
    states = ("active", "drained")

    def all_run(supervisor, table):
        supervisor.poll()
        found = table.states()
        return set(found) == set(deployment.nodes) and set(found.values()) <= set(states)

    # An earlier run has created the logins.
    run(deployment.model_copy(update={"nodes": {"clock": {}}}), lambda supervisor, table: None)
    if fault == "full":
        disk.fill()
    else:
        disk.set_read_only(True)

    def without_disk(supervisor, table):
        wait_until(lambda: all_run(supervisor, table), 120.0)
        wait_until(lambda: "NOT RECORDING" in detail(table, "recorder"), 10.0)
        assert "NOT SAVED" in detail(table, "monitor")
        if fault == "read-only":  # on the full disk it has written nothing yet
            assert "NOT DURABLE" in detail(table, "keyframes")
        process = supervisor.children["recorder"].process.pid
        os.kill(process, signal.SIGKILL)

        def restarted():
            supervisor.poll()
            return supervisor.children["recorder"].process.pid != process and all_run(supervisor, table)

        wait_until(restarted, 120.0)
        if fault == "full":
            disk.free()
        else:
            disk.set_read_only(False)

        def recorded():
            supervisor.poll()
            with RecordingReader(path / "new" / "rec") as reader:
                return reader.counts["tick"] > 1

        wait_until(lambda: (path / "new" / "rec").exists() and recorded(), 120.0)
        wait_until(lambda: "writing" in detail(table, "recorder"), 10.0)

    run(deployment, without_disk)
