"""A lidar as a node: its turns as scans, with stamps that no change of the host's time moves."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator

import numpy as np

from beamsplat.common.messages import Scan
from beamsplat.common.runtime.clock import StampClock
from beamsplat.common.runtime.node import Node, Sourced
from beamsplat.services.lidar.config import HokuyoConfig, LidarConfig, RplidarConfig
from beamsplat.services.lidar.driver import LidarDriver
from beamsplat.services.lidar.hokuyo import HokuyoDriver
from beamsplat.services.lidar.ldrobot import LdrobotDriver
from beamsplat.services.lidar.link import DeviceLink, open_link
from beamsplat.services.lidar.reader import LidarReader
from beamsplat.services.lidar.rplidar import RplidarDriver
from beamsplat.services.lidar.samples import StampedScan


class _LidarNode(Node, ABC):
    """What the kinds share. A device that is not there yet, or gone, is waited for."""

    Config = LidarConfig
    config: LidarConfig

    @abstractmethod
    def driver(self) -> LidarDriver:
        """The driver of this kind."""

    def configure(self) -> None:
        """Makes ready; opening waits until the stream is asked for, so that an absent device is a status."""
        bauds = (self.config.baud,) if self.config.baud else ()
        self._reader = LidarReader(self.driver, self._open, bauds, StampClock().now_ns)

    def _open(self, baud: int) -> DeviceLink:
        return open_link(self.config.device, baud)

    def source(self) -> Iterator[Sourced | None]:
        """Scans for ever; None while there is nothing to say."""
        for scan in self._reader.scans():
            self.detail = self._reader.status
            yield None if scan is None else Sourced(None, "lidar/scan", self.message(scan))

    def message(self, scan: StampedScan) -> Scan:
        """A turn as it goes out. NaN: not measured; no device here tells "nothing there" from "not seen"."""
        turn, sign = scan.revolution, -1.0 if self.config.upside_down else 1.0
        range_max_m = self.config.range_max_m or scan.range_max_m
        # Consumers take what lies beyond for free space; a device has no business to say so.
        ranges_m = np.where(turn.range_m <= range_max_m, turn.range_m, np.float32(np.nan))
        return Scan(
            stamp_ns=scan.stamp_ns,
            angle_min_rad=sign * turn.angle_min_rad,
            angle_increment_rad=sign * turn.angle_increment_rad,
            time_increment_s=turn.time_increment_s,
            scan_time_s=turn.scan_time_s,
            range_min_m=self.config.range_min_m or scan.range_min_m,
            range_max_m=range_max_m,
            ranges_m=ranges_m.astype(np.float32),
            intensities=np.asarray(turn.intensity, np.float32),
        )

    def close(self) -> None:
        if hasattr(self, "_reader"):
            self._reader.close()


class RplidarNode(_LidarNode):
    """SLAMTEC RPLIDAR A, S and C series."""

    name = "lidar"
    Config = RplidarConfig
    config: RplidarConfig
    outputs = ("lidar/scan",)

    def driver(self) -> LidarDriver:
        return RplidarDriver(self.config.mode)


class LdrobotNode(_LidarNode):
    """LDROBOT LD06 and LD19."""

    name = "lidar"
    outputs = ("lidar/scan",)

    def driver(self) -> LidarDriver:
        return LdrobotDriver()


class HokuyoNode(_LidarNode):
    """Hokuyo over serial or TCP."""

    name = "lidar"
    Config = HokuyoConfig
    config: HokuyoConfig
    outputs = ("lidar/scan",)

    def driver(self) -> LidarDriver:
        return HokuyoDriver(self.config.intensity)
