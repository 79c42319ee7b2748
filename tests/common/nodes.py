"""Small nodes for tests of the runners; they use topics of the real topic table."""

import hashlib
import time
from collections.abc import Iterator

import numpy as np

from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.common.messages import Correction, ExternalPose, GridTile, Image, Odometry, Scan, WheelOdometry
from beamsplat.common.runtime.node import Input, Job, Node, Outputs, SourceItem
from beamsplat.common.runtime.registry import Service
from tests.common.tiles import tile


class SensorSourceConfig(NodeConfig):
    seconds: float = 3.0
    scans: bool = True
    images: bool = True
    image_bytes: int = 2000
    seed: int = 0


class SensorSource(Node):
    """Publishes scans at 10 Hz, wheel odometry at 50 Hz and images at 30 Hz, each with its own latency and jitter."""

    name = "replay"
    Config = SensorSourceConfig
    outputs = ("lidar/scan", "wheel/odometry", "camera/image")

    def source(self) -> Iterator[SourceItem]:
        rng = np.random.default_rng(self.config.seed)
        items = []
        for i in range(int(self.config.seconds * 50)):
            stamp_ns = 1_000_000_000 + i * 20_000_000
            pose = se2_to_se3(np.array([0.01 * i, 0.0, 0.0]))
            items.append(
                SourceItem(
                    stamp_ns + int(rng.uniform(1e6, 9e6)),
                    "wheel/odometry",
                    WheelOdometry(stamp_ns=stamp_ns, T_odom_body=pose, velocity_m_s=np.zeros(3),
                                  angular_velocity_rad_s=np.zeros(3)),
                )
            )  # fmt: skip
        for i in range(int(self.config.seconds * 10) if self.config.scans else 0):
            stamp_ns = 1_003_000_000 + i * 100_000_000
            items.append(
                SourceItem(
                    stamp_ns + 100_000_000 + int(rng.uniform(1e6, 9e6)),
                    "lidar/scan",
                    Scan(stamp_ns=stamp_ns, angle_min_rad=-3.14, angle_increment_rad=0.01, time_increment_s=0.0,
                         scan_time_s=0.1, range_min_m=0.1, range_max_m=12.0,
                         ranges_m=rng.uniform(0, 12, 360).astype(np.float32)),
                )
            )  # fmt: skip
        for i in range(int(self.config.seconds * 30) if self.config.images else 0):
            stamp_ns = 1_005_000_000 + i * 33_333_333
            data = rng.integers(0, 255, self.config.image_bytes).astype(np.uint8)
            items.append(
                SourceItem(
                    stamp_ns + 20_000_000,
                    "camera/image",
                    Image(stamp_ns=stamp_ns, width_px=640, height_px=480, encoding="jpeg", data=data),
                )
            )
        yield from sorted(items, key=lambda item: item.at_ns)


class Chain(Node):
    """Publishes, per scan, a digest of all messages so far, which depends on their order."""

    name = "localization"
    inputs = ("lidar/scan", "wheel/odometry")
    outputs = ("localization/odometry", "localization/correction")

    def configure(self) -> None:
        self._digest = hashlib.sha256()
        self._jobs = 0

    def on_wheel_odometry(self, message: WheelOdometry) -> Outputs:
        self._digest.update(message.T_odom_body.tobytes())
        return iter(())

    def on_lidar_scan(self, message: Scan) -> Outputs:
        self._digest.update(message.ranges_m.tobytes())
        detail = self._digest.hexdigest()
        yield (
            "localization/odometry",
            Odometry(stamp_ns=message.stamp_ns, T_odom_body=np.eye(4), covariance=np.eye(3), detail=detail),
        )
        if int(detail[:2], 16) < 64:
            yield Job("sum", lambda: float(message.ranges_m.sum()), after=2, of="lidar/scan")

    def on_job_sum(self, result: float) -> Outputs:
        self._jobs += 1
        self._digest.update(str(result).encode())
        T = se2_to_se3(np.array([result, 0.0, 0.0]))
        yield (
            "localization/correction",
            Correction(stamp_ns=self._jobs, T_map_odom=T, optimisation=self._jobs),
        )

    def on_query_count(self, parameters: dict[str, str]) -> Iterator[Correction]:
        yield Correction(stamp_ns=0, T_map_odom=np.eye(4), optimisation=int(parameters.get("add", 0)))


class SlowConfig(NodeConfig):
    sleep_s: float = 0.0


class Slow(Node):
    """Handles the newest image slowly (`sleep_s`), and every scan."""

    name = "localization"
    Config = SlowConfig
    inputs = ("camera/image", "lidar/scan")
    outputs = ("localization/grid",)

    def on_camera_image(self, message: Image) -> Outputs:
        time.sleep(self.config.sleep_s)
        yield (
            "localization/grid",
            tile(message.stamp_ns, message.data[:4].astype(np.int8).reshape(2, 2)),
        )  # fmt: skip

    def on_lidar_scan(self, message: Scan) -> Outputs:
        return iter(())


class Sink(Node):
    """Stores all received messages in `seen`."""

    name = "recorder"
    inputs = (
        "localization/odometry",
        Input("localization/correction", delivery="every"),
        Input("localization/grid", delivery="every"),
    )

    def __init__(self, config: NodeConfig) -> None:
        super().__init__(config)
        self.seen: list[tuple[str, object]] = []

    def on_localization_odometry(self, message: Odometry) -> Outputs:
        self.seen.append(("localization/odometry", message))
        return iter(())

    def on_localization_correction(self, message: Correction) -> Outputs:
        self.seen.append(("localization/correction", message))
        return iter(())

    def on_localization_grid(self, message: GridTile) -> Outputs:
        self.seen.append(("localization/grid", message))
        return iter(())


class PoseSource(Node):
    """Publishes five poses at once, without an arrival time, like a device."""

    name = "ros2"
    outputs = ("external/pose",)

    def source(self) -> Iterator[SourceItem]:
        for i in range(5):
            yield SourceItem(None, "external/pose", ExternalPose(stamp_ns=i, T_map_body=np.eye(4)))


_HERE = "tests.common.nodes:"
TABLE = {
    "replay": Service("replay", "", {"drive": _HERE + "SensorSource"}),
    "localization": Service("localization", "", {"chain": _HERE + "Chain", "slow": _HERE + "Slow"}),
    "recorder": Service("recorder", "", {"sink": _HERE + "Sink"}),
}
