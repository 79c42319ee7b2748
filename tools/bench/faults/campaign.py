"""`bench faults`: the whole system under random faults, and what of it did not survive."""

from __future__ import annotations

import json
import random
import re
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from beamsplat.common.errors import UserError
from beamsplat.common.files.persist import make_folder, write_atomically
from beamsplat.tools.bench.faults.hosts import ROUTER, CampaignHost, CampaignHosts, Role
from beamsplat.tools.bench.faults.kinds import InjectedFault, Surfaces, Target, deck
from beamsplat.tools.bench.faults.saved_files import unreadable
from beamsplat.tools.bench.faults.timeline import timeline
from beamsplat.tools.bench.faults.watch import Gap, HostWatch, KeyframeWatch, PoseWatch
from beamsplat.tools.bench.lap_recording import lap_recording
from beamsplat.tools.bench.process_samples import ProcessSamples
from beamsplat.tools.simulator.settings import CameraSettings

START_S = 240.0  # limit for the first start: kernels may have to be compiled
RECOVER_S = 60.0  # after the faults of a round have ended, every process must work again within this time
ROUND_S = 75.0  # faults, before the system may recover
BETWEEN_S = (5.0, 10.0)  # between the starts of two faults
LONGEST_GAP_S = 3.0  # without localization, beyond what the faults explain
ACKNOWLEDGE_S = 120.0  # at the end, all keyframes must be at the edge within this time
_SAMPLE_S = 5.0
_POLL_S = 0.2
_STOPPED, NO_CAUSE = "localization was stopped", "none"
_FAULTS_BEFORE = 6  # that are listed with a finding
_DIED = re.compile(r"^(\S+) died \((.*)\)")
_LATE_S = 20.0  # a process that a fault stopped may end, be replaced and start up this long after the fault
_CAMERA = CameraSettings(width_px=320, height_px=240, rate_hz=5.0)  # a small machine keeps up
Log = Callable[[str], None]


@dataclass(frozen=True)
class CampaignFinding:
    """A fault of the product: when it was seen, what it was, and the last faults before it."""

    time_s: float
    text: str
    faults_before: list[str]


@dataclass(frozen=True)
class Restart:
    """A process that was replaced by a new one."""

    time_s: float
    role: Role
    name: str
    expected: bool  # a fault had killed or restarted it
    reason: str


class Campaign:
    """One run; `run` returns its report."""

    def __init__(self, out: Path, data: Path, minutes: float, seed: int, rate: float, log: Log) -> None:
        """Prepare a campaign in the folder `out` with the recording `data`.

        Raises:
            UserError: a deployment is invalid, or a folder cannot be created.
        """
        self._out, self._log, self._minutes, self._seed = make_folder(out), log, minutes, seed
        self._rng = random.Random(seed)
        self._hosts = CampaignHosts(out, data, rate)
        self._began = time.monotonic()
        self._faults: list[tuple[float, float, InjectedFault]] = []  # start and end, in s
        self._active: list[tuple[float, float, InjectedFault]] = []  # start and planned end
        self.findings: list[CampaignFinding] = []
        self._restarts: list[Restart] = []
        self._pids: dict[Target, int] = {}
        self._samples = ProcessSamples()
        self._recoveries: list[float] = []
        self._survived = 0  # faults of rounds without a finding
        self._found_before = 0  # findings at the end of the previous round
        self._watches: dict[Role, HostWatch] = {}
        self._reasons: dict[Target, str] = {}  # why a process ended, from the output of `beamsplat run`

    def run(self) -> dict[str, Any]:
        """Start the hosts, inject faults for the given time, and return the report, which is also written.

        Raises:
            UserError: the system does not start at all.
        """
        began = time.monotonic()
        self._hosts.start()
        try:
            self._connect()
            self._wait_until_healthy(START_S, "start")
            if self.findings:
                raise UserError(f"the system does not start: {self.findings[0].text}")
            self._poses.begin()
            self._began = self._poses.began
            self._log(f"started in {self._began - began:.0f} s; faults for {self._minutes:g} min")
            self._inject()
            self._finish()
        finally:
            stopped = {host.role: host.stop() for host in reversed(self._hosts.all)}
            for watch in self._watches.values():
                watch.close()
        for role, seconds in stopped.items():
            if seconds is None:
                self._find(f"{role}: did not stop within 30 s after Ctrl-C")
        self._read_output()
        for role, texts in unreadable(self._hosts, everything=True).items():
            for text in texts:
                self._find(f"{role}: cannot be read after the end: {text}")
        self._lost = self._lost_keyframes()
        return self._report()

    def _now(self) -> float:
        return time.monotonic() - self._began

    def _connect(self) -> None:
        for host in self._hosts.all:
            self._watches[host.role] = HostWatch(host)
        outbox = self._hosts.robot.deployment.run_dir / "keyframes"
        self._poses, self._keyframes = PoseWatch(), KeyframeWatch(outbox)
        robot = self._watches["robot"]
        robot.subscribe("localization/odometry", self._poses.take)
        robot.subscribe("keyframes/frame", self._keyframes.take_frame)
        for watch in self._watches.values():
            watch.subscribe("keyframes/ack", self._keyframes.take_ack)
        self._surfaces = Surfaces.of(self._hosts, self._watches)

    # --- faults ---

    def _inject(self) -> None:
        """Inject faults in rounds; after each round, the system must recover."""
        kinds: list[Callable[[Surfaces, random.Random], InjectedFault]] = []
        ends = time.monotonic() + self._minutes * 60.0
        while time.monotonic() < ends:
            first = len(self._faults)
            round_ends = min(time.monotonic() + ROUND_S, ends)
            next_fault = time.monotonic()
            while time.monotonic() < round_ends:
                if time.monotonic() >= next_fault:
                    kinds = kinds or deck(self._rng)
                    fault = kinds.pop()(self._surfaces, self._rng)
                    if not fault.part or all(fault.part != active.part for *_, active in self._active):
                        self._begin(fault)
                    next_fault += self._rng.uniform(*BETWEEN_S)
                self._poll()
            while self._active:
                self._poll()
            self._check_recovery(first)

    def _check_recovery(self, first: int) -> None:
        """Check that everything works after a round; its faults are those from number `first` on."""
        self._recoveries.append(self._wait_until_healthy(RECOVER_S, "the faults of this round"))
        self._check_files()
        if len(self.findings) == self._found_before:
            self._survived += len(self._faults) - first
        self._found_before = len(self.findings)

    def _begin(self, fault: InjectedFault) -> None:
        now = self._now()
        self._log(f"{now:7.1f} s  {fault.text}" + (f", {fault.duration_s:.0f} s" if fault.duration_s else ""))
        fault.start()
        self._active.append((now, now + fault.duration_s, fault))

    def _poll(self) -> None:
        """End faults whose time has passed; observe processes, output and keyframes."""
        now = self._now()
        for entry in [entry for entry in self._active if entry[1] <= now]:
            began, _, fault = entry
            self._active.remove(entry)
            fault.end()
            self._faults.append((began, now, fault))
            if fault.disk:
                self._check_files()
        self._observe()
        time.sleep(_POLL_S)

    def _observe(self) -> None:
        now = self._now()
        self._keyframes.waiting()
        self._read_output()
        pids = {(host.role, name): pid for host in self._hosts.all for name, pid in host.pids().items()}
        for target, pid in pids.items():
            if self._pids.get(target, pid) != pid:
                self._note_restart(target, now)
        self._pids.update(pids)
        series = self._samples.series
        if not series or now - max(s[-1].time_s for s in series.values()) >= _SAMPLE_S:
            self._samples.take(now, {f"{role}:{name}": pid for (role, name), pid in pids.items()})
        for host in self._hosts.all:
            if host.exit_code is not None:
                self._find(f"{host.role}: `beamsplat run` ended with exit code {host.exit_code}: "
                           f"{_last_line(host)}")  # fmt: skip
                self._pids = {target: pid for target, pid in self._pids.items() if target[0] != host.role}
                host.start()

    def _note_restart(self, target: Target, now: float) -> None:
        role, name = target
        expected = any(
            target in fault.stopped and now <= end + _LATE_S for _, end, fault in self._known_faults()
        )
        reason = self._reasons.pop(target, "")
        self._restarts.append(Restart(now, role, name, expected, reason))
        if not expected:
            tail = self._hosts_by_role[role].log_tail(name)
            self._find(f"{role}: {name} was replaced, which no fault asked for: {reason or tail}")

    def _known_faults(self) -> list[tuple[float, float, InjectedFault]]:
        return [*self._faults, *self._active]

    @property
    def _hosts_by_role(self) -> dict[Role, CampaignHost]:
        return {host.role: host for host in self._hosts.all}

    def _read_output(self) -> None:
        """Take the reasons of restarts from what `beamsplat run` prints."""
        for host in self._hosts.all:
            for line in host.new_lines():
                if found := _DIED.match(line):
                    self._reasons[(host.role, found[1])] = found[2]
                elif " cannot run" in line or "Traceback" in line or "killed" in line:
                    self._log(f"{host.role}: {line}")

    # --- checks ---

    def _find(self, text: str, at_s: float | None = None) -> None:
        """Add a finding of the time `at_s`, by default now, with the faults that began last before it."""
        at_s = self._now() if at_s is None else at_s
        known = sorted((began, fault.text) for began, _, fault in self._known_faults() if began <= at_s)
        before = [f"{began:.1f} s: {text}" for began, text in known[-_FAULTS_BEFORE:]]
        self.findings.append(CampaignFinding(round(at_s, 1), text, before))
        self._log(f"{at_s:7.1f} s  FINDING {text}")

    def _wait_until_healthy(self, limit_s: float, after: str) -> float:
        """Wait until every process works and poses arrive; return the time in s that it took."""
        began = time.monotonic()
        while True:
            wrong = {
                (role, name): text for role, watch in self._watches.items()
                for name, text in watch.unhealthy().items()
            }  # fmt: skip
            if self._poses.last_s == 0.0 or time.monotonic() - self._poses.began - self._poses.last_s > 1.0:
                wrong["robot", "poses"] = f"no valid pose; rejected: {self._poses.rejected}"
            if not wrong:
                break
            if time.monotonic() - began > limit_s:
                for (role, name), text in wrong.items():
                    tail = self._hosts_by_role[role].log_tail(name)
                    self._find(f"{role}: {name} does not work {limit_s:.0f} s after {after}: {text}; {tail}")
                break
            self._observe()
            time.sleep(_POLL_S)
        return time.monotonic() - began

    def _check_files(self) -> None:
        for role, texts in unreadable(self._hosts).items():
            for text in texts:
                self._find(f"{role}: cannot be read: {text}")

    def _finish(self) -> None:
        """Wait until the edge has acknowledged all keyframes."""
        deadline = time.monotonic() + ACKNOWLEDGE_S
        while (waiting := self._keyframes.waiting()) and time.monotonic() < deadline:
            self._observe()
            time.sleep(_POLL_S)
        if waiting:
            detail = self._watches["robot"].health.records["keyframes"].health.detail
            self._find(
                f"robot: {len(waiting)} keyframes are not acknowledged after {ACKNOWLEDGE_S:.0f} s: {detail}"
            )
        self._poses.finish()
        for gap, cause, unexplained_s in self._gaps():
            if unexplained_s > LONGEST_GAP_S:
                why = "no fault explains" if cause == NO_CAUSE else f"began because {cause}"
                self._find(
                    f"robot: no localization for {gap.seconds:.1f} s, {unexplained_s:.1f} s more than faults "
                    f"explain ({why}; statuses meanwhile: {gap.rejected})", gap.end_s,
                )  # fmt: skip

    def _gaps(self) -> list[tuple[Gap, str, float]]:
        """Return the times without localization, each with its cause and its unexplained seconds."""
        known = [(began, end, *_explanation(fault)) for began, end, fault in self._faults]
        return [(gap, *explained(gap, known)) for gap in self._poses.gaps]

    def _lost_keyframes(self) -> list[int]:
        """Return the ids of keyframes that the robot made and that are nowhere: not at the edge, not refused.

        What is in the outbox is sent after the next start: the robot makes keyframes until it is stopped.
        """
        from beamsplat.common.mapfiles.session import SessionFolder

        session = SessionFolder(Path(self._hosts.edge.deployment.nodes["mapping"]["session"]))
        waiting = self._keyframes.waiting()
        lost = self._keyframes.made - set(session.keyframe_ids()) - set(self._keyframes.refused) - waiting
        if lost:
            acknowledged = len(lost & self._keyframes.acknowledged)
            ids = sorted(lost)[:5]
            self._find(f"{len(lost)} keyframes are lost, of which {acknowledged} were acknowledged: {ids}")
        return sorted(lost)

    # --- report ---

    def _report(self) -> dict[str, Any]:
        gaps = self._gaps()
        others = [gap.seconds for gap, cause, _ in gaps if cause != _STOPPED]
        kinds = Counter(fault.kind for _, _, fault in self._faults)
        texts = [finding.text for finding in self.findings]
        memory = {
            name: {figure: [round(float(f(self._samples.values(name, figure))), 1) for f in (min, max)]
                   for figure in ("private_mb", "descriptors", "threads")}
            for name in sorted(self._samples.series)
        }  # fmt: skip
        by_cause: dict[str, float] = {}
        for gap, cause, _ in gaps:
            by_cause[cause] = by_cause.get(cause, 0.0) + gap.seconds
        report = {
            "folder": str(self._out), "minutes": self._minutes, "seed": self._seed,
            "faults": {"injected": len(self._faults), "survived": self._survived,
                       "by_kind": dict(sorted(kinds.items()))},
            "without_localization_s": {
                "total": sum(gap.seconds for gap, *_ in gaps),
                "longest": max((gap.seconds for gap, *_ in gaps), default=0.0),
                "total_while_localization_ran": sum(others),
                "longest_while_localization_ran": max(others, default=0.0), "by_cause": by_cause,
            },
            "keyframes": {"made": len(self._keyframes.made), "refused": len(self._keyframes.refused),
                          "lost": len(self._lost)},
            "wedged": sum("does not work" in text for text in texts),
            "unreadable": sum("cannot be read" in text for text in texts),
            "recovery_s": {"longest": max(self._recoveries, default=0.0)},
            "restarts": [asdict(restart) for restart in self._restarts],
            "processes": memory,
            "findings": [asdict(finding) for finding in self.findings],
        }  # fmt: skip
        self._samples.write_csv(self._out / "samples.csv")
        rows = [
            (f.kind, began, end, f.text + "".join(f"; {r}" for r in f.result))
            for began, end, f in self._faults
        ]
        write_atomically(self._out / "faults.json", json.dumps(rows, indent=0).encode())
        picture = timeline(
            self._now(), rows, [(gap.start_s, gap.end_s, cause) for gap, cause, _ in gaps],
            [(r.time_s, f"{r.role}: {r.name}", r.expected) for r in self._restarts],
            [(finding.time_s, finding.text) for finding in self.findings],
        )  # fmt: skip
        write_atomically(self._out / "timeline.svg", picture.encode())
        write_atomically(self._out / "report.json", json.dumps(report, indent=1).encode())
        return report


def _explanation(fault: InjectedFault) -> tuple[str, float]:
    """Return why a fault interrupts localization, or "", and for how many s after its end."""
    stopped = {name for role, name in fault.stopped if role == "robot"}
    if "localization" in stopped:
        return _STOPPED, _LATE_S
    if "replay" in stopped:
        return "the sensors were stopped", _LATE_S
    if ROUTER in stopped:
        return "the router was stopped", _LATE_S
    return ("the sensors failed", 0.0) if fault.sensors else ("", 0.0)


def explained(gap: Gap, faults: list[tuple[float, float, str, float]]) -> tuple[str, float]:
    """Return the cause of a time without localization, and how many of its seconds no fault explains.

    Args:
        gap: the time without localization.
        faults: (start s, end s, what it does to localization, s after its end that it explains).
    """
    spans = sorted((began, end + late_s, why) for began, end, why, late_s in faults if why)
    cause, at_s, unexplained_s = NO_CAUSE, gap.start_s, 0.0
    for began, end, why in spans:
        if end <= at_s or began >= gap.end_s:
            continue
        cause = why if cause == NO_CAUSE or why == _STOPPED else cause
        unexplained_s += max(began - at_s, 0.0)
        at_s = end
    return cause, unexplained_s + max(gap.end_s - at_s, 0.0)


def _last_line(host: CampaignHost) -> str:
    lines = host.output.read_text(errors="replace").splitlines()
    return lines[-1] if lines else ""


def bench_faults(
    data: Path | None, minutes: float, seed: int, out: Path, rate: float, log: Log
) -> dict[str, Any]:
    """Run a campaign of random faults, write its report into `out`, and return it.

    Args:
        data: recording that the robot plays in a loop; None: a simulated lap, made in `out` at the first run.
        minutes: time in which faults are injected.
        seed: of the random plan; processes and times also depend on the course of the run.
        out: folder of all files.
        rate: speed of the replay, in multiples of real time.
        log: receives one line per fault and finding.

    Raises:
        UserError: the system does not start.
    """
    data = data or lap_recording(make_folder(out), log, _CAMERA)
    return Campaign(out / time.strftime("%Y%m%d-%H%M%S"), data, minutes, seed, rate, log).run()
