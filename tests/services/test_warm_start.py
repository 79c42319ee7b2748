"""A live node has its kernels before it reports that it is active: a drive does not wait for them."""

from tests.common.kernels import kernels_of

_CONFIGURE = """
    from pathlib import Path
    from beamsplat.common.runtime.live_settings import LiveSettings
    from beamsplat.services.{service} import {node} as Node

    node = Node(Node.Config())
    node.live_settings = LiveSettings("r1", (), Path("/nonexistent"))
    node.configure()
"""


def test_fusion_needs_no_more_kernels_for_a_drive_than_it_has_when_it_is_active():
    warmed, missing = kernels_of(
        warm=_CONFIGURE.format(service="fusion.node", node="FusionNode"),
        use="""
            from tests.services.fusion.test_keyframe_jobs import run
            depths = run()[1]
            assert sum(m.status == "ok" for m in depths) == len(depths)
        """,
    )
    assert len(warmed) >= 10
    assert missing == []


def test_localization_needs_no_more_kernels_for_a_drive_than_it_has_when_it_is_active():
    warmed, missing = kernels_of(
        warm=_CONFIGURE.format(service="localization.lidar2d.node", node="LidarLocalization"),
        use="""
            from beamsplat.common.runtime.lockstep import Lockstep
            from beamsplat.services.localization.lidar2d.node import LidarLocalization
            from tests.services.fusion.room_nodes import RoomSource, RoomSourceConfig

            node, poses = LidarLocalization(LidarLocalization.Config(grid_every_scans=10)), []
            source = RoomSource(RoomSourceConfig(images=12))

            def on_message(envelope):
                if envelope.topic == "localization/odometry":
                    poses.append(envelope.message.status)

            Lockstep([source, node], on_message).run()
            assert set(poses) == {"ok"}
        """,
    )
    assert len(warmed) >= 10
    # The grid is drawn by a job, beside the scans.
    assert [kernel for kernel in missing if ".lidar2d.occupancy." not in kernel] == []
