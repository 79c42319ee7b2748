"""Real processes that succeed each other: by a crash, by another supervisor, and without the folder of the seed."""

import os
import signal

import pytest

from beamsplat.common.config.deployment import Deployment, RouterConfig
from beamsplat.common.errors import UserError
from beamsplat.common.zenoh.bus import open_router, open_session
from beamsplat.tools.system.supervisor import Supervisor
from beamsplat.tools.system.swap import Swap
from tests.common.nodes import TABLE
from tests.common.polling import poll
from tests.common.topic_listener import TopicListener
from tests.tools.system.test_live_system import SinkThread
from tests.tools.system.test_swap import _TABLE as SWAP_TABLE
from tests.tools.system.test_swap import NODES

ODOMETRY = "localization/odometry"


@pytest.fixture
def system(tmp_path, free_endpoint):
    """Make deployments with one router, which outlives them all; `folder` has the state of the supervisor."""

    def make(folder):
        return Deployment(
            robot="test", router=RouterConfig(listen=(free_endpoint,)), state_dir=tmp_path / folder,
            nodes={"replay": {"kind": "drive", "seconds": 300.0, "images": False}, "localization": {"kind": "chain"}},
        )  # fmt: skip

    with open_router((free_endpoint,)):
        yield make


def test_a_subscriber_accepts_every_process_of_a_robot(system):
    first, elsewhere = system("a"), system("b")
    names = ("replay", "localization")
    with SinkThread(first) as sink:
        count = sink.live.running.mailbox.counts[ODOMETRY]

        def receives_more(supervisor):
            before = len(sink.stamps(ODOMETRY))
            poll(supervisor, lambda: len(sink.stamps(ODOMETRY)) > before + 3, 30.0)
            return count.producer.current

        with Supervisor(first, names, table=TABLE) as supervisor:
            epoch = receives_more(supervisor).epoch
            os.kill(supervisor.children["localization"].process.pid, signal.SIGKILL)
            poll(supervisor, lambda: count.producer.current.epoch == epoch + 1, 30.0)
            receives_more(supervisor)
        with Supervisor(first, names, table=TABLE) as supervisor:  # of the same folder
            receives_more(supervisor)
        assert (count.refused, count.lost) == (0, 0)
        known = count.producer.current
        with Supervisor(elsewhere, names, table=TABLE) as supervisor:  # its folder was deleted
            now = receives_more(supervisor)
        assert now.epoch < known.epoch
        assert now.instance != known.instance


def test_a_successor_of_a_process_that_was_restarted_meanwhile_is_not_swapped_in(tmp_path, free_endpoint):
    deployment = Deployment(
        robot="r1", router=RouterConfig(listen=(free_endpoint,)), state_dir=tmp_path, nodes=NODES
    )
    with (
        Supervisor(deployment, table=SWAP_TABLE) as supervisor,
        open_session(deployment.router.listen) as session,
    ):
        poses = TopicListener(session, ODOMETRY)
        poll(supervisor, lambda: len(poses.messages) > 3, 30.0)
        successor = supervisor.successor("localization", ("sleep_s=0.02",), warm=True)
        os.kill(supervisor.children["localization"].process.pid, signal.SIGKILL)
        poll(supervisor, lambda: supervisor.children["localization"].restarts == 1, 30.0)
        restarted = supervisor.children["localization"].instance
        swap = Swap(session, supervisor, successor)
        with pytest.raises(UserError, match="started again while its successor started"):
            poll(supervisor, swap.poll, 30.0)
        assert supervisor.children["localization"].instance == restarted
        successor.process.join(10.0)
        assert not successor.process.is_alive()
        count = len(poses.messages)
        poll(supervisor, lambda: len(poses.messages) > count + 3, 30.0)
