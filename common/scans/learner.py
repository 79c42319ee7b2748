"""Learning of a lidar's rules from its first messages and from the motion of the robot."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from beamsplat.common.geometry.rig import ScanSection
from beamsplat.common.recording.input_report import InputFault
from beamsplat.common.scans.clocks import stamped_at_end
from beamsplat.common.scans.header_rules import HeaderFacts, learn_header
from beamsplat.common.scans.laser import LaserMessage
from beamsplat.common.scans.motion import MANY_PAIRS, OrderEvidence, SweepMotion, describe_sweep
from beamsplat.common.scans.mount_check import MotionComparison, MountEstimate
from beamsplat.common.scans.rules import AngleRule, ScanRules, read_angles
from beamsplat.common.scans.sweeps import make_sweep

HEADER_MESSAGES = 24  # from which the rules of the header are learnt
MAX_SCANS = 1500  # of which the motion is computed
_MAX_PAIRS = 40  # compared sweeps
_STEP_NS = 70_000_000  # sweeps that are nearer in time are left out of the motion
_MIN_TURN_RATE = 0.15  # rad/s, for a comparison of sweeps
_MOTIONS = 30  # of the body and the lidar, for the mount
_HANDED = 0.8  # correlation of the turns
_MAX_YAW_RAD = math.radians(20.0)  # between the mount by the motion and that of the transforms, for a choice


class _Track:
    """Motion and evidence under one reading of the directions."""

    def __init__(self, angles: AngleRule, sweeps_s: tuple[float, ...]) -> None:
        self.angles = angles
        self.motion = SweepMotion()
        self.order = OrderEvidence(sweeps_s)
        self.comparison = MotionComparison()
        self._compared = 0

    def add(self, message: LaserMessage, rules: ScanRules, stamp_ns: int) -> None:
        try:
            first, step = read_angles(message, replace(rules, angles=self.angles))
        except InputFault:
            return
        with np.errstate(invalid="ignore"):
            ranges = message.ranges_m * np.float32(rules.range_scale)
        top = rules.range_max_m or message.range_max_m * rules.limit_scale
        low = message.range_min_m * rules.limit_scale if rules.range_min_m is None else rules.range_min_m
        if rules.no_return_m is not None:
            top = min(top, 0.999 * rules.no_return_m)
        low = low if math.isfinite(low) and 0.0 <= low < top else 0.0
        sweep = make_sweep(stamp_ns, ranges, first + step * np.arange(len(ranges)), low, top)
        turned = self.motion.add(sweep)
        if turned is None or turned.twist is None:
            return
        self.comparison.add_lidar(turned.chain, turned.sweep.stamp_ns, turned.pose, float(turned.twist[2]))
        self._compared += 1
        turning = abs(turned.twist[2]) > _MIN_TURN_RATE
        if turning and self.order.pairs < _MAX_PAIRS and self._compared % 2 == 0:
            self.order.compare(turned, self.motion.tracked)


class ScanLearner:
    """Collects evidence on how the scans of one stream are to be read.

    Add messages and odometry in order of reception until `done`; `rules` are what is known at any time.
    """

    def __init__(self, section: ScanSection | None = None) -> None:
        """`section`: values of a rig file, which are not found out."""
        self.section = section or ScanSection()
        self.T_body_lidar: np.ndarray | None = None  # [4, 4] by the transforms, if known
        self.facts: HeaderFacts | None = None
        self._header: list[LaserMessage] = []
        self._base = ScanRules()
        self._tracks: list[_Track] = []
        self._odometry: list[tuple[int, np.ndarray]] = []  # before the header is learnt
        self._last_ns = 0
        self.scans = 0

    def add_odometry(self, stamp_ns: int, pose_odom_body: np.ndarray) -> None:
        """Add a pose float64 [3] (x m, y m, yaw rad) of wheel odometry."""
        if not self._tracks:
            self._odometry.append((stamp_ns, pose_odom_body))
            del self._odometry[:-2000]
        for track in self._tracks:
            track.comparison.add_odometry(stamp_ns, pose_odom_body)

    def add(self, message: LaserMessage) -> None:
        """Add the next message."""
        if self.facts is None:
            self._header.append(message)
            if len(self._header) >= HEADER_MESSAGES:
                self.learn_header()
            return
        self._track(message)

    def learn_header(self) -> None:
        """Learn the rules of the header from the messages so far, if there are any."""
        if self.facts is not None or not self._header:
            return
        self._base, self.facts = learn_header(self._header)
        candidates = self.facts.angle_candidates
        if self.section.angles is not None:
            candidates = (self.section.angles,)
        self._tracks = [_Track(rule, self.facts.sweep_candidates_s) for rule in candidates]
        for stamp_ns, pose in self._odometry:
            self.add_odometry(stamp_ns, pose)
        header, self._header, self._odometry = self._header, [], []
        for message in header:
            self._track(message)

    def _track(self, message: LaserMessage) -> None:
        stamp_ns = message.at_ns if self._base.use_received or not message.stamp_ns else message.stamp_ns
        if message.frame_id != self._base.frame_id or not len(message.ranges_m):
            return
        if 0 <= stamp_ns - self._last_ns < _STEP_NS:
            return
        self._last_ns = stamp_ns
        self.scans += 1
        # The time of the middle of the sweep, so that it does not depend on the order of the beams.
        assert self.facts is not None
        half_ns = round(0.5e9 * abs(self.facts.sweep_candidates_s[0]))
        middle_ns = stamp_ns - half_ns if self._base.use_received else stamp_ns + half_ns
        for track in self._tracks:
            track.add(message, self._base, middle_ns)

    @property
    def done(self) -> bool:
        """Return whether more messages would hardly change the rules."""
        if self.facts is None:
            return False
        if self.scans >= MAX_SCANS:
            return True
        for track in self._tracks:
            pairs = track.order.pairs
            if pairs < _MAX_PAIRS and not (pairs >= MANY_PAIRS and track.order.decide() is not None):
                return False
            if track.comparison.has_odometry and (
                track.comparison.handedness() is None or not self._mount_is_known(track)
            ):
                return False
        return True

    def _mount_is_known(self, track: _Track) -> bool:
        found = track.comparison.mount(mirrored=self._is_mirrored(track))
        return self.scans > 600 or (found is not None and found.motions >= _MOTIONS)

    @property
    def undecided(self) -> bool:
        """Return whether the fields of the directions contradict each other and nothing has decided yet."""
        return len(self._tracks) > 1 and self._choose_track()[1] == ""

    def _expected_sign(self) -> float:
        """Return -1 for a lidar that is mounted upside down by its transform, else 1."""
        return -1.0 if self.T_body_lidar is not None and self.T_body_lidar[2, 2] < 0.0 else 1.0

    def _handedness(self, track: _Track) -> float:
        """Return the correlation of the turns of lidar and wheels, as mounted; 0 = unknown."""
        found = track.comparison.handedness()
        return 0.0 if found is None else found * self._expected_sign()

    def _is_mirrored(self, track: _Track) -> bool:
        """Return whether the motion of the lidar must be mirrored to fit that of the wheels."""
        return (track.comparison.handedness() or self._expected_sign()) < 0.0

    def _choose_track(self) -> tuple[_Track, str]:
        """Return the reading of the directions that fits the data best, and why; "" = the default."""
        left = self._tracks
        for better in [track for track in left if self._handedness(track) > _HANDED][:1]:
            left_now = [track for track in left if self._handedness(track) > -_HANDED]
            if len(left_now) == 1:
                correlation = self._handedness(better)
                return (
                    better,
                    f"the turns then agree with those of the odometry, correlation {correlation:.2f}",
                )
            left = left_now
        if self.T_body_lidar is not None and len(left) > 1:
            errors = [self._yaw_error(track) for track in left]
            good = [track for track, error in zip(left, errors) if error is not None and error < _MAX_YAW_RAD]
            if len(good) == 1 and None not in errors:
                return good[0], "the motion then agrees with the odometry and the mount of the lidar"
            left = good or left
        if len(left) > 1:
            means = [
                float(track.order.means_m.min()) if track.order.pairs >= MANY_PAIRS else math.inf
                for track in left
            ]
            best = int(np.argmin(means))
            others = [mean for i, mean in enumerate(means) if i != best]
            if math.isfinite(means[best]) and means[best] < 0.88 * min(others):
                said = f"{100 * means[best]:.1f} instead of {100 * min(others):.1f} cm"
                return left[best], f"sweeps in different headings then agree to {said}"
        return left[0], ""

    def _yaw_error(self, track: _Track) -> float | None:
        estimate = track.comparison.mount(mirrored=self._is_mirrored(track))
        if estimate is None or self.T_body_lidar is None:
            return None
        yaw = math.atan2(self.T_body_lidar[1, 0], self.T_body_lidar[0, 0])
        return abs(math.remainder(estimate.yaw_rad - yaw, 2.0 * math.pi))

    def rules(self) -> ScanRules:
        """Return the rules by all evidence so far."""
        facts, section = self.facts, self.section
        if facts is None:  # provisional, until there are enough messages
            return learn_header(self._header)[0] if self._header else ScanRules()
        rules = self._base
        track, why = self._choose_track()
        rules = replace(rules, angles=track.angles, angles_why=why or rules.angles_why)
        if section.angles is not None:
            rules = replace(rules, angles_why="as set in the rig file")
        rules = self._with_handedness(rules, track)
        rules = self._with_order(rules, track)
        return self._with_stamp(rules)

    def _with_handedness(self, rules: ScanRules, track: _Track) -> ScanRules:
        if self.section.mirrored is not None:
            return replace(rules, mirrored=self.section.mirrored, mirrored_why="as set in the rig file")
        if self._handedness(track) > -_HANDED or not track.comparison.odometry_is_consistent():
            return rules
        error = self._yaw_error(track)
        if error is not None and error > _MAX_YAW_RAD:
            return rules  # not mirrored only; `warnings` tells
        return replace(rules, mirrored=True, mirrored_why="they turn opposite to the wheel odometry")

    def _with_order(self, rules: ScanRules, track: _Track) -> ScanRules:
        facts, section = self.facts, self.section
        assert facts is not None
        default = facts.sweep_candidates_s[0]
        if section.order is not None or section.sweep_s is not None:
            duration = section.sweep_s if section.sweep_s is not None else abs(default)
            sign = {"forward": 1.0, "reversed": -1.0, "none": 0.0}[section.order or "forward"]
            return replace(rules, sweep_s=sign * duration, sweep_why="set in the rig file")
        chosen = track.order.decide()
        if chosen is None or abs(track.order.candidates_s[chosen] - default) < 1e-3:
            return rules
        sweep_s = track.order.candidates_s[chosen]
        why = f"contradicted by the data ({track.order.sentence()})"
        if facts.sweep_fault:
            why = f"{facts.sweep_fault} ({track.order.sentence()})"
        return replace(rules, sweep_s=sweep_s, sweep_why=why)

    def _with_stamp(self, rules: ScanRules) -> ScanRules:
        facts = self.facts
        assert facts is not None
        if self.section.stamp is not None:
            return replace(rules, stamp_at=self.section.stamp, stamp_why="as set in the rig file")
        sweep_s = abs(facts.sweep_candidates_s[0] if rules.sweep_s is None else rules.sweep_s)
        if rules.use_received or not facts.receive_times_tell:
            return rules
        if stamped_at_end(facts.lag_s, sweep_s):
            why = (
                f"the scans are received {facts.lag_s * 1e3:.0f} ms after their stamps, but their beams take "
                f"{sweep_s * 1e3:.0f} ms"
            )
            return replace(rules, stamp_at="last", stamp_why=why)
        if facts.sweep_candidates_s[0] < 0.0:  # a negative increment may be the driver's word for clockwise
            return replace(rules, stamp_at="first", stamp_why="the scans are received after a whole sweep")
        return rules

    def found_section(self) -> ScanSection | None:
        """Return what the data have decided as the section [lidar.scan] of a rig file; None if nothing."""
        if self.facts is None:
            return None
        rules, track = self.rules(), self._choose_track()[0]
        values: dict[str, object] = {}
        if track.order.decide() is not None or rules.sweep_s is not None:
            sweep_s = self.facts.sweep_candidates_s[0] if rules.sweep_s is None else rules.sweep_s
            values["order"] = "none" if sweep_s == 0.0 else "forward" if sweep_s > 0.0 else "reversed"
            values["sweep_s"] = round(abs(sweep_s), 6)
        if rules.stamp_at is not None:
            values["stamp"] = rules.stamp_at
        if len(self._tracks) > 1 and not self.undecided:
            values["angles"] = rules.angles
        if rules.mirrored:
            values["mirrored"] = True
        return ScanSection.model_validate(values) if values else None

    def evidence(self) -> str:
        """Return one sentence on how the order and the time of the beams were found."""
        if self.facts is None:
            return "no scans"
        rules, track = self.rules(), self._choose_track()[0]
        sweep_s = self.facts.sweep_candidates_s[0] if rules.sweep_s is None else rules.sweep_s
        beam = rules.stamp_at or "first"
        said = f"the beams are measured {describe_sweep(sweep_s)}, the stamp is that of the {beam}"
        if track.order.decide() is not None:
            return f"{said}: {track.order.sentence()}"
        pairs = track.order.pairs
        return f"{said}, as the messages state; {pairs} pairs of sweeps in turns do not show another order"

    def mount(self) -> MountEstimate | None:
        """Return the planar mount of the lidar by the motion; None if it is not known."""
        if not self._tracks:
            return None
        track = self._choose_track()[0]
        return track.comparison.mount(mirrored=self._is_mirrored(track))

    def warnings(self) -> list[str]:
        """Return sentences on disagreement of the scans with wheel odometry and transforms."""
        if not self._tracks:
            return []
        found = []
        rules, track = self.rules(), self._choose_track()[0]
        if self._handedness(track) < -_HANDED and not rules.mirrored:
            found.append(
                "header: the scans turn opposite to the wheel odometry: either the yaw of the odometry "
                "has the "
                "wrong sign, or the lidar is mounted upside down and its transform does not say so; "
                "correct it"
            )
        found += self._timeless(rules)
        found += _mount_warnings(self.mount(), self.T_body_lidar)
        delay = track.comparison.delay_s()
        if delay is not None and abs(delay[0]) > max(0.15, 2.0 * delay[1]):
            word = "later" if delay[0] > 0.0 else "earlier"
            found.append(
                f"header.stamp: the turns of the wheel odometry are stamped {abs(delay[0]):.2f} +- "
                f"{delay[1]:.2f} s "
                f"{word} than those of the scans; synchronise the clocks (localization corrects up to 0.3 s)"
            )
        return found

    def _timeless(self, rules: ScanRules) -> list[str]:
        """Return a sentence if the scans have no time per beam, but arrive like those of a turning lidar."""
        facts = self.facts
        if facts is None or rules.sweep_s is not None or facts.sweep_candidates_s[0] != 0.0:
            return []
        turning_s = max(facts.sweep_candidates_s)
        if not facts.receive_times_tell or facts.lag_s < 0.5 * turning_s or turning_s == 0.0:
            return []
        return [
            "time_increment = 0: the scans do not say when each beam was measured, and are received "
            f"{facts.lag_s * 1e3:.0f} ms after their stamps like those of a turning lidar: they are not "
            "deskewed; "
            "set order and sweep_s in [lidar.scan] of a rig file, or drive turns, in which the order shows"
        ]


def _mount_warnings(estimate: MountEstimate | None, T_body_lidar: np.ndarray | None) -> list[str]:
    if estimate is None:
        return []
    found = []
    if not 0.8 < estimate.scale < 1.25:
        found.append(
            f"ranges: the scans say {1.0 / estimate.scale:.2f} m of motion for each metre of the wheel "
            "odometry: the "
            "unit of the ranges or the wheel odometry is wrong; correct it"
        )
    if T_body_lidar is None:
        return found
    yaw = math.atan2(T_body_lidar[1, 0], T_body_lidar[0, 0])
    error = math.remainder(estimate.yaw_rad - yaw, 2.0 * math.pi)
    if abs(error) > max(math.radians(6.0), 5.0 * estimate.yaw_sigma_rad):
        found.append(
            f"transform of the lidar: its yaw is {math.degrees(yaw):.0f} deg, but by the motion of the "
            "robot and the "
            f"wheel odometry it is {math.degrees(estimate.yaw_rad):.0f} +- "
            f"{max(math.degrees(estimate.yaw_sigma_rad), 1.0):.0f} deg; correct the transform"
        )
    off = estimate.xy_m - T_body_lidar[:2, 3]
    if float(np.hypot(*off)) > max(0.10, 4.0 * estimate.xy_sigma_m):
        found.append(
            f"transform of the lidar: it is at x {T_body_lidar[0, 3]:.2f}, y {T_body_lidar[1, 3]:.2f} "
            "m, but by the "
            f"motion in turns at x {estimate.xy_m[0]:.2f}, y {estimate.xy_m[1]:.2f} +- "
            f"{estimate.xy_sigma_m:.2f} m; "
            "correct the transform"
        )
    return found
