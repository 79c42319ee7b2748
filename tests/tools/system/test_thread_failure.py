"""An exception in any thread of a node ends its process: it is restarted, and the reason is shown."""

import threading
import time

import numpy as np
import pytest

from beamsplat.common.config.deployment import Deployment, NodeConfig, RouterConfig
from beamsplat.common.messages import Odometry
from beamsplat.common.runtime.node import Node
from beamsplat.common.runtime.registry import Service
from beamsplat.tools.system.supervisor import Supervisor
from tests.common.nodes import TABLE
from tests.common.polling import poll

FAILS_AFTER_NS = 1_500_000_000  # stamp; the drive begins at 1 s


class FailingConfig(NodeConfig):
    where: str = ""


class Failing(Node):
    """Has a fault on arrival of a message, on a health report, or in a thread of its own."""

    name = "localization"
    Config = FailingConfig
    inputs = ("lidar/scan",)
    outputs = ("localization/odometry",)

    def configure(self):
        if self.config.where == "own thread":
            threading.Thread(target=self._work, daemon=True).start()

    def _work(self):
        time.sleep(1.0)
        raise RuntimeError("fault in the own thread")

    def on_arrival(self, topic, message):
        if self.config.where == "arrival" and message.stamp_ns > FAILS_AFTER_NS:
            raise RuntimeError("fault in the arrival")
        return ()

    def on_lidar_scan(self, scan):
        odometry = Odometry(stamp_ns=scan.stamp_ns, T_odom_body=np.eye(4), covariance=np.eye(3))
        yield "localization/odometry", odometry


OWN = Service("localization", "", {"failing": "tests.tools.system.test_thread_failure:Failing"})


@pytest.mark.parametrize("where", ["arrival", "own thread"])
def test_an_exception_in_a_thread_ends_the_process_which_is_restarted(tmp_path, free_endpoint, where):
    nodes = {
        "replay": {"kind": "drive", "seconds": 60.0, "images": False},
        "localization": {"kind": "failing", "where": where},
    }
    deployment = Deployment(
        robot="r1", router=RouterConfig(listen=(free_endpoint,)), state_dir=tmp_path, nodes=nodes
    )
    events = []
    table = {**TABLE, "localization": OWN}
    with Supervisor(deployment, table=table, on_event=events.append) as supervisor:
        poll(supervisor, lambda: supervisor.children["localization"].restarts > 0, 30.0)
        (event,) = [e for e in events if e.startswith("localization")][:1]
        assert f"fault in the {where}" in event
        assert "exit code 1" in event
