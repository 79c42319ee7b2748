"""The reader of one stream of planar scans: learns how its messages are to be read, and reads them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from beamsplat.common.geometry.rig import ScanSection
from beamsplat.common.recording.input_report import InputFault, InputReport
from beamsplat.common.scans.assembly import TurnAssembler, are_parts, are_sectors
from beamsplat.common.scans.laser import LaserMessage
from beamsplat.common.scans.learner import HEADER_MESSAGES, ScanLearner
from beamsplat.common.scans.rules import ScanRules, apply_rules

_HOLD_SCANS = 300  # scans of a live robot that are refused while contradicting fields are not decided
_UPDATE_SCANS = 20  # scans between two looks at the evidence, on a live robot
MIN_RETURNS = 20  # of a scan that localization uses


class ScanReader:
    """Reads the scans of one topic. Use `learn` on recorded data, `observe` and `read` on a live robot.

    What was repaired or refused is counted in `report`.
    """

    def __init__(
        self, topic: str, report: InputReport, section: ScanSection | None = None, *, as_stated: bool = False
    ) -> None:
        """Create the reader.

        Args:
            topic: its name in the report.
            report: receives repairs and refusals.
            section: values of a rig file that are not found out.
            as_stated: the messages are of our own drivers: directions and times are correct.
        """
        self.topic, self.report = topic, report
        self.learner = ScanLearner(section)
        self._rules: ScanRules | None = ScanRules() if as_stated else None
        self._live = not as_stated
        self._assembler: TurnAssembler | None = None
        self._first: list[LaserMessage] = []
        self._read = 0
        self.offset_ns, self.offset_why = 0, ""
        self._warnings: list[str] | None = None  # of a live robot, at the last look at the evidence
        self.sparse = 0  # scans with fewer than `MIN_RETURNS` returns

    @property
    def rules(self) -> ScanRules:
        return ScanRules() if self._rules is None else self._rules

    def set_mount(self, T_body_lidar: np.ndarray) -> None:
        """Set the mount [4, 4] by the transforms, which the motion of the robot is compared with."""
        self.learner.T_body_lidar = T_body_lidar

    def set_offset(self, offset_ns: int, why: str) -> None:
        """Add `offset_ns` to all stamps, because of `why` (the clock of the lidar is another one)."""
        self.offset_ns, self.offset_why = offset_ns, why

    def again(self, report: InputReport) -> ScanReader:
        """Return a reader with the rules of this one, for another pass over the same data."""
        other = ScanReader(self.topic, report, self.learner.section, as_stated=True)
        other.learner, other._rules, other._first = self.learner, self._rules, self._first
        other.set_offset(self.offset_ns, self.offset_why)
        if self._assembler is not None:
            other._assembler = TurnAssembler(sectors=self._assembler.sectors)
        return other

    def _on_clock(self, message: LaserMessage) -> LaserMessage:
        """Return a message with its stamp on the common clock."""
        if not self.offset_ns or not message.stamp_ns:
            return message
        return replace(message, stamp_ns=message.stamp_ns + self.offset_ns)

    def learn(self, messages: Iterable[LaserMessage | tuple[int, np.ndarray]]) -> None:
        """Learn the rules from recorded scans and odometry (stamp ns, pose [3]), until they are known."""
        for message in messages:
            if isinstance(message, LaserMessage):
                message = self._on_clock(message)
                if len(self._first) < HEADER_MESSAGES:
                    self._first.append(message)
                self.learner.add(message)
                if self.learner.scans % _UPDATE_SCANS == 1 and self.learner.done:
                    break
            else:
                self.learner.add_odometry(*message)
        self._live = False
        self.learner.learn_header()
        self._adopt()

    def observe(self, message: LaserMessage) -> None:
        """Learn from a message of a live robot that is not used itself."""
        message = self._on_clock(message)
        if len(self._first) < HEADER_MESSAGES:
            self._first.append(message)
        self.learner.add(message)

    def add_odometry(self, stamp_ns: int, pose_odom_body: np.ndarray) -> None:
        """Learn from a pose float64 [3] of the wheel odometry of a live robot."""
        if self._live and not self.learner.done:
            self.learner.add_odometry(stamp_ns, pose_odom_body)

    def read(self, message: LaserMessage) -> list[dict[str, Any]]:
        """Return the fields of the `Scan` messages of `message`: one, or none while a turn is incomplete.

        Raises:
            InputFault: the message cannot be used; it is not counted yet.
        """
        if self._live:
            self._learn_live(message)
        repairs: list[tuple[str, object, str, str]] = []
        if self.offset_ns and message.stamp_ns:
            what = f"{self.offset_why}: {self.offset_ns / 1e9:.3f} s is added"
            repairs.append(
                ("header.stamp", f"{message.stamp_ns / 1e9:.3f} s", what, "synchronise the clocks")
            )
            message = self._on_clock(message)
        fields = apply_rules(message, self.rules, lambda *repair: repairs.append(repair))
        for repair in repairs:
            self.report.repaired(self.topic, *repair)
        if self._assembler is not None:
            return self._assemble(fields, len(message.ranges_m))
        with np.errstate(invalid="ignore"):
            ranges = fields["ranges_m"]
            returns = (ranges > fields["range_min_m"]) & (ranges < fields["range_max_m"])
        self.sparse += int(returns.sum()) < MIN_RETURNS
        return [fields]

    def _learn_live(self, message: LaserMessage) -> None:
        self._read += 1
        if not self.learner.done:
            self.observe(message)
        if self._rules is None or self._read < _UPDATE_SCANS or self._read % _UPDATE_SCANS == 0:
            self._adopt()
        if self.learner.undecided and self._read < _HOLD_SCANS:
            raise InputFault(
                "angle_increment", f"{message.angle_increment_rad:.6g}",
                f"{len(message.ranges_m)} beams from angle_min {message.angle_min_rad:.4g} do not end "
                "at angle_max "
                f"{message.angle_max_rad:.4g}, and nothing shows yet which field is wrong",
                "drive a curve, or set angles in [lidar.scan] of a rig file",
            )  # fmt: skip

    def _adopt(self) -> None:
        self._rules = self.learner.rules()
        self._warnings = self.learner.warnings() if self._live else None
        if self._assembler is None and len(self._first) >= 6:
            fields = []
            for message in self._first:
                try:
                    fields.append(apply_rules(message, self._rules, lambda *_: None))
                except InputFault:
                    continue
            sectors = are_sectors(fields)
            if sectors or are_parts(fields):
                self._assembler = TurnAssembler(sectors=sectors)

    def _assemble(self, fields: dict[str, Any], beams: int) -> list[dict[str, Any]]:
        assert self._assembler is not None
        dropped = self._assembler.interrupted
        turn = self._assembler.add(fields)
        self.report.repaired(
            self.topic,
            "ranges",
            f"{beams} beams",
            "each message is a part of a revolution: they are assembled",
            "",
        )
        for _ in range(self._assembler.interrupted - dropped):
            self.report.refused(
                self.topic,
                InputFault("ranges", f"{beams} beams", "the next part of the revolution is missing"),
            )
        return [] if turn is None else [turn]

    @property
    def warnings(self) -> list[str]:
        """Return sentences on scans that disagree with odometry and transforms, or have few returns."""
        texts = self.learner.warnings() if self._warnings is None else self._warnings
        found = [f"{self.topic}: {text}" for text in texts]
        if self.sparse:
            found.append(
                f"{self.topic}: ranges: {self.sparse} scans have fewer than {MIN_RETURNS} returns "
                "between range_min and "
                "range_max; localization cannot use them"
            )
        return found
