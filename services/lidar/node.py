"""The lidar nodes: publish revolutions as scans, with stamps independent of the host's wall clock."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator

import numpy as np

from beamsplat.common.messages import Scan
from beamsplat.common.recording.input_report import InputReport
from beamsplat.common.runtime.clock import StampClock
from beamsplat.common.runtime.node import Node, SourceItem
from beamsplat.common.scans.laser import laser_of_fields
from beamsplat.common.scans.reader import ScanReader
from beamsplat.services.lidar.config import HokuyoConfig, LidarConfig, RplidarConfig
from beamsplat.services.lidar.driver import LidarDriver
from beamsplat.services.lidar.hokuyo import HokuyoDriver
from beamsplat.services.lidar.ldrobot import LdrobotDriver
from beamsplat.services.lidar.link import DeviceLink, open_link
from beamsplat.services.lidar.reader import LidarReader
from beamsplat.services.lidar.rplidar import RplidarDriver
from beamsplat.services.lidar.samples import StampedScan


class _LidarNode(Node, ABC):
    """Base class of the lidar nodes; reconnects to a device that is missing or fails."""

    Config = LidarConfig
    config: LidarConfig

    @abstractmethod
    def driver(self) -> LidarDriver:
        """Return a new driver for the configured device."""

    def configure(self) -> None:
        """Prepare the reader of the device.

        The device is opened later, so that a missing device is reported as a status and not as an error.
        """
        bauds = (self.config.baud,) if self.config.baud else ()
        self._reader = LidarReader(self.driver, self._open, bauds, StampClock().now_ns)
        self._report = InputReport()
        self._scans = ScanReader("lidar/scan", self._report, as_stated=True)

    def _open(self, baud: int) -> DeviceLink:
        return open_link(self.config.device, baud)

    def source(self) -> Iterator[SourceItem | None]:
        """Yield scans without end; None while no scan is complete."""
        for scan in self._reader.scans():
            self.detail = self._reader.status
            counters = self._reader.driver.counters
            self.rejections.set("revolutions dropped: too few measurements", counters.dropped_scans)
            self.rejections.set("packets damaged", counters.bad_packets)
            self.rejections.set("measurements missing or not plausible", counters.lost_samples)
            message = None if scan is None else self._read(scan)
            for finding in self._report.findings:
                self.rejections.set(finding.reason, finding.count)
            yield None if message is None else SourceItem(None, "lidar/scan", message)

    def _read(self, scan: StampedScan) -> Scan | None:
        """Return the message of a revolution as read by the one reader of scans; None if it is refused."""
        try:
            fields = self._scans.read(laser_of_fields(vars(self.message(scan)), scan.stamp_ns))
            return Scan.model_validate(fields[0]) if fields else None
        except ValueError as error:
            self._report.refused("lidar/scan", error)
            return None

    def message(self, scan: StampedScan) -> Scan:
        """Return the scan message of a revolution, before `_read` has checked it.

        Ranges beyond the limit become NaN (not measured): subscribers interpret +inf as free space, and these
        devices do not distinguish "nothing within range" from "not measured".
        """
        turn, sign = scan.revolution, -1.0 if self.config.upside_down else 1.0
        range_max_m = self.config.range_max_m or scan.range_max_m

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
    """Node of SLAMTEC RPLIDAR A, S and C series."""

    name = "lidar"
    Config = RplidarConfig
    config: RplidarConfig
    outputs = ("lidar/scan",)

    def driver(self) -> LidarDriver:
        return RplidarDriver(self.config.mode)


class LdrobotNode(_LidarNode):
    """Node of LDROBOT LD06 and LD19."""

    name = "lidar"
    outputs = ("lidar/scan",)

    def driver(self) -> LidarDriver:
        return LdrobotDriver()


class HokuyoNode(_LidarNode):
    """Node of Hokuyo lidars over serial port, USB or TCP."""

    name = "lidar"
    Config = HokuyoConfig
    config: HokuyoConfig
    outputs = ("lidar/scan",)

    def driver(self) -> LidarDriver:
        return HokuyoDriver(self.config.intensity)
