"""An emulated lidar on a serial line and SLAM, in separate processes as on a robot."""

import time

import numpy as np

from beamsplat.common.config.deployment import Deployment, RouterConfig
from beamsplat.common.runtime.node import Input
from beamsplat.common.zenoh.bus import Bus, open_session
from beamsplat.tools.system.health_table import HealthTable
from beamsplat.tools.system.supervisor import Supervisor
from tests.services.lidar.devices import EmulatedPort, Ld19

RIG = "[lidar.mount]\nxyz_m = [0.0, 0.0, 0.2]\nrpy_deg = [0.0, 0.0, 0.0]\n"


def test_localization_with_a_lidar_on_a_noisy_link(tmp_path, free_endpoint):
    path = str(tmp_path / "lidar")
    (tmp_path / "rig.toml").write_text(RIG)
    nodes = {
        "camera": {"kind": "none", "rig": str(tmp_path / "rig.toml")},
        "lidar": {"kind": "ldrobot", "device": path},
        "localization": {"kind": "lidar"},
    }
    deployment = Deployment(
        robot="test", router=RouterConfig(listen=(free_endpoint,)), state_dir=tmp_path / "state", nodes=nodes
    )
    poses = []
    with (
        EmulatedPort(Ld19(), path, corruption=0.01),
        Supervisor(deployment) as supervisor,
        Bus(open_session((free_endpoint,)), "test", "x", "cd" * 8, 1) as bus,
    ):
        board = HealthTable(bus.session, "test")
        bus.subscribe(Input("localization/odometry"), lambda x: poses.append(x.message), lambda *a: None,
                      lambda *a: None)  # fmt: skip
        deadline = time.monotonic() + 60
        while len([p for p in poses if p.status == "ok"]) < 30 and time.monotonic() < deadline:
            supervisor.poll()
            time.sleep(0.05)
        detail = board.records["lidar"].health.detail
        stopped = time.monotonic()
    assert time.monotonic() - stopped < 6.0, "a process had to be killed"
    good = [p for p in poses if p.status == "ok"]
    assert len(good) >= 30
    wandered_m = max(float(np.linalg.norm(p.T_odom_body[:3, 3])) for p in good)
    assert wandered_m < 0.03
    assert "NOISY LINK" in detail
    assert "LDROBOT" in detail
