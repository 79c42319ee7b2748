"""Localization on a robot whose disk blocks: poses and optimisations continue while a checkpoint is written."""

import os
import threading

import numpy as np

from beamsplat.common.messages import LidarModel, Rig, Scan
from beamsplat.common.runtime.jobs import JobQueue, JobThreads
from beamsplat.common.runtime.live_settings import LiveSettings
from beamsplat.common.runtime.node import Job
from beamsplat.services.localization.lidar2d.node import LidarLocalization
from beamsplat.services.localization.lidar2d.state import MANIFEST, read_manifest
from tests.services.localization.world import RayCastLidar, SimulatedDrive

T0 = 1_000_000_000_000


class Robot:
    """A localization node with its background jobs, as in a live process, and the flat that it drives in."""

    def __init__(self, run_dir, **options):
        self.node = LidarLocalization(LidarLocalization.Config(kind="lidar", **options))
        self.node.live_settings = LiveSettings("r1", (), run_dir)
        self.node.configure()
        give_up = threading.Event()
        timer = threading.Timer(60.0, give_up.set)
        timer.daemon = True
        timer.start()
        self.jobs = JobQueue(JobThreads(give_up.is_set).submit)
        self.lidar, self.path, self.scans, self.sent = RayCastLidar(beams=180), SimulatedDrive(), 0, {}
        self._take(self.node.handle("rig", Rig(stamp_ns=T0, lidar=LidarModel(T_body_lidar=np.eye(4)))))

    def _take(self, outputs):
        for output in outputs:
            if isinstance(output, Job):
                self.jobs.start(output)
                self.sent.setdefault(f"job {output.name}", []).append(output)
            else:
                self.sent.setdefault(output[0], []).append(output[1])

    def drive(self, scans):
        angle_min, increment, dt, least, most = self.lidar.arguments()
        for _ in range(scans):
            self.scans += 1
            t = self.scans * 0.1
            for results in (self.jobs.finished(), self.jobs.before_message("lidar/scan")):
                for name, result in results:
                    self.sent.setdefault(f"result of {name}", []).append(result)
                    self._take(self.node.handle_job(name, result))
            scan = Scan(
                stamp_ns=T0 + int(t * 1e9), angle_min_rad=angle_min, angle_increment_rad=increment,
                time_increment_s=dt, scan_time_s=0.1, range_min_m=least, range_max_m=most,
                ranges_m=self.lidar.scan(self.path, t),
            )  # fmt: skip
            self._take(self.node.handle("lidar/scan", scan))


def test_a_disk_that_blocks_delays_no_optimisation_and_no_pose(tmp_path):
    folder = tmp_path / "localization"
    robot = Robot(tmp_path, keep_every_s=1.0)
    folder.mkdir()
    pipe = folder / f".{MANIFEST}.{os.getpid()}"  # opening it to write blocks until somebody reads
    os.mkfifo(pipe)
    robot.drive(170)
    assert len(robot.sent["job checkpoint"]) == 1  # it is still being written
    assert "result of checkpoint" not in robot.sent
    assert len(robot.sent["result of optimise"]) >= 2
    assert len(robot.sent["localization/odometry"]) == 170
    assert {o.status for o in robot.sent["localization/odometry"]} == {"ok"}
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)  # the disk answers again: with an error
    for name, fault in robot.jobs.remaining_results():
        if name == "checkpoint":
            list(robot.node.handle_job(name, fault))
            assert "not written" in robot.node.detail
    os.close(reader)
    robot.drive(40)  # the next checkpoint is written
    list(robot.jobs.remaining_results())
    assert read_manifest(folder)["keynodes"] > 10
