"""Command `beamsplat simulate`: records a drive of a simulated robot."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from beamsplat.tools.cli.options import writable

if TYPE_CHECKING:
    from beamsplat.tools.simulator.lidar_records import RecordingSummary
    from beamsplat.tools.simulator.robots import RobotPreset

console = Console(stderr=True)


def _numbers(text: str, count: int, option: str) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count:
        raise typer.BadParameter(
            f"expected {count} numbers separated by commas, got {text!r}", param_hint=option
        )
    return values


def _size(text: str, low: int, high: int, unit: str) -> tuple[int, int]:
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(p.isdigit() for p in parts):
        raise typer.BadParameter(f"expected WIDTHxHEIGHT, got {text!r}", param_hint="--size")
    first, second = int(parts[0]), int(parts[1])
    if not (low <= first <= high and low <= second <= high):
        raise typer.BadParameter(f"both numbers must be {low} to {high} {unit}", param_hint="--size")
    return first, second


def simulate(
    out: Annotated[Path, typer.Option(callback=writable, help="Folder to write; it must not exist yet.")],
    seconds: Annotated[
        float | None, typer.Option(min=1.0, help="Length of the recording; default: one lap, about 80 s.")
    ] = None,
    laps: Annotated[
        int | None,
        typer.Option(min=1, help="Number of laps; the images of one lap are rendered once and reused."),
    ] = None,
    movers: Annotated[
        int, typer.Option(min=0, max=200, help="Number of walking people; at most 6 in a home.")
    ] = 0,
    carts: Annotated[int, typer.Option(min=0, max=3, help="Number of rolling carts.")] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the home, the route and the noise.")] = 0,
    drive: Annotated[
        int,
        typer.Option(
            min=0, max=1000, help="Number of the drive in the same home: another start, other noise."
        ),
    ] = 0,
    moved: Annotated[
        int, typer.Option(min=0, max=20, help="Pieces of furniture moved since drives without this option.")
    ] = 0,
    removed: Annotated[int, typer.Option(min=0, max=20, help="Pieces removed, likewise.")] = 0,
    added: Annotated[int, typer.Option(min=0, max=20, help="Pieces added, likewise.")] = 0,
    changes_seed: Annotated[
        int, typer.Option(min=0, help="Seed that selects the pieces moved, removed and added.")
    ] = 0,
    size: Annotated[
        str,
        typer.Option(help="Image size in pixels (default 640x480); office: size in metres (default 120x80)."),
    ] = "",
    rate_hz: Annotated[
        float | None,
        typer.Option(min=0.5, max=60.0, help="Image rate of the camera (default 10, or the robot's)."),
    ] = None,
    robot: Annotated[
        str,
        typer.Option(
            help="Sensors, topics, frames, drivers of turtlebot4, rosmaster_x3, ugv_ld19 or jetrover_g4."
        ),
    ] = "",
    scene: Annotated[
        Path | None,
        typer.Option(exists=True, dir_okay=False, help="glTF/GLB scene instead of a generated home."),
    ] = None,
    glass: Annotated[
        bool, typer.Option("--glass", help="Let some lidar beams pass through glazed doors.")
    ] = False,
    lidar_only: Annotated[
        bool, typer.Option("--lidar-only", help="No camera: fast, for long drives.")
    ] = False,
    site: Annotated[
        str, typer.Option(help="'home', or 'office': a large office floor, only with --lidar-only.")
    ] = "home",
    distance_m: Annotated[
        float, typer.Option(min=20.0, help="Office: driven distance, before the way back to the start.")
    ] = 3000.0,
    aliased: Annotated[
        bool, typer.Option("--aliased", help="Office: identical rooms along identical corridors.")
    ] = False,
    lost: Annotated[
        int,
        typer.Option(
            min=0, max=50, help="Office: number of drives of 30 s without measurements into unknown space."
        ),
    ] = 0,
    clock_offset_ms: Annotated[
        float, typer.Option(min=-10_000.0, max=10_000.0, help="Fault: added to the stamps of the images.")
    ] = 0.0,
    extrinsic_yaw_deg: Annotated[
        float,
        typer.Option(
            min=-180.0, max=180.0, help="Fault: the camera in tf is rotated to the left of the true one."
        ),
    ] = 0.0,
    extrinsic_pitch_deg: Annotated[
        float,
        typer.Option(min=-90.0, max=90.0, help="Fault: the camera in tf points lower than the true one."),
    ] = 0.0,
    extrinsic_roll_deg: Annotated[
        float, typer.Option(min=-180.0, max=180.0, help="Fault: the camera in tf is rolled.")
    ] = 0.0,
    extrinsic_xyz_m: Annotated[
        str, typer.Option(help="Fault: the camera in tf is displaced by x,y,z.")
    ] = "0,0,0",
    distortion: Annotated[
        str, typer.Option(help="Lens distortion k1,k2,p1,p2,k3 (plumb_bob).")
    ] = "0,0,0,0,0",
    exposure_changes: Annotated[
        bool, typer.Option("--exposure-changes", help="Fault: the exposure varies.")
    ] = False,
    jobs: Annotated[int, typer.Option(min=1, help="Number of rendering processes.")] = os.cpu_count() or 1,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing folder.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Simulate a robot that drives through a generated home, and record it with exact ground truth.

    The folder contains bag/ (ROS 2, MCAP) without ground truth, and beside it groundtruth.txt, camera.json,
    depth_gt/, moving_masks/, beams.npz, extra_views/ and gt_surface.ply; with --moved, --removed or --added
    also changes.json, the boxes of the changed furniture in the frame of groundtruth.txt. Worlds and images
    are cached in $BEAMSPLAT_CACHE (default ~/.cache/beamsplat) and reused.

    Examples:

    beamsplat simulate --out rec --seconds 30

    beamsplat simulate --out rec --seconds 60 --movers 2 --seed 7

    beamsplat simulate --out small --size 320x240 --rate-hz 5

    beamsplat simulate --out soak --lidar-only --laps 40

    beamsplat simulate --out site --site office --size 120x80 --lidar-only --distance-m 3000 --movers 30

    beamsplat simulate --out tb4 --robot turtlebot4 --lidar-only

    beamsplat simulate --out tuesday --seed 7 --drive 1 --moved 5

    beamsplat simulate --out faulty --clock-offset-ms 40 --extrinsic-yaw-deg 2 --distortion=-0.12,0.03,0,0,0
    """
    preset = _preset(robot, size if site == "home" else "", distortion)
    if moved + removed + added and (site != "home" or scene is not None):
        raise typer.BadParameter(
            "changes a generated home: leave out --site and --scene", param_hint="--moved, --removed, --added"
        )
    if site == "office":
        if not lidar_only:
            raise typer.BadParameter("an office has no camera: add --lidar-only", param_hint="--site")
        length_m, width_m = _size(size or "120x80", 30, 1000, "metres")

        def office(progress: Callable[[str, int, int], None]) -> RecordingSummary:
            from beamsplat.tools.simulator.office.recording import simulate_office
            from beamsplat.tools.simulator.office.settings import OfficeSettings

            chosen = OfficeSettings(
                seed=seed, length_m=length_m, width_m=width_m, distance_m=distance_m, aliased=aliased,
                lost=lost, people=movers,
            )  # fmt: skip
            if preset is not None:
                chosen = preset.applied_to_office(chosen)
            return simulate_office(chosen, out, replace=force, progress=progress)

        _record(office, out, as_json)
        return
    if site != "home":
        raise typer.BadParameter(f"'home' or 'office', got {site!r}", param_hint="--site")
    if movers > 6:
        raise typer.BadParameter("a home has room for at most 6 people", param_hint="--movers")
    from beamsplat.tools.simulator import recording
    from beamsplat.tools.simulator.changes import Rearrangement
    from beamsplat.tools.simulator.settings import CameraSettings, Faults, LidarSettings, SimulationSettings

    width, height = _size(size or "640x480", 32, 4096, "pixels")
    k1, k2, p1, p2, k3 = _numbers(distortion, 5, "--distortion")
    x_m, y_m, z_m = _numbers(extrinsic_xyz_m, 3, "--extrinsic-xyz-m")
    camera = CameraSettings(
        width_px=width, height_px=height, rate_hz=rate_hz or 10.0, distortion=(k1, k2, p1, p2, k3)
    )
    settings = SimulationSettings(
        seed=seed,
        drive=drive,
        rearrangement=(
            Rearrangement(moved, removed, added, changes_seed) if moved + removed + added else None
        ),
        seconds=seconds,
        laps=laps,
        people=movers,
        carts=carts,
        scene=None if scene is None else str(scene),
        lidar_only=lidar_only,
        camera=camera,
        lidar=LidarSettings(glass=glass),
        faults=Faults(
            clock_offset_ms=clock_offset_ms,
            extrinsic_xyz_m=(x_m, y_m, z_m),
            extrinsic_yaw_deg=extrinsic_yaw_deg,
            extrinsic_pitch_deg=extrinsic_pitch_deg,
            extrinsic_roll_deg=extrinsic_roll_deg,
            exposure_changes=exposure_changes,
        ),
    )
    if preset is not None:
        settings = preset.applied(settings, rate_hz)
    _record(
        lambda progress: recording.simulate(settings, out, jobs=jobs, replace=force, progress=progress),
        out,
        as_json,
    )


def _preset(name: str, size: str, distortion: str) -> RobotPreset | None:
    """Return the preset of the option --robot; None without it."""
    if not name:
        return None
    from beamsplat.tools.simulator.robots import ROBOTS

    if name not in ROBOTS:
        raise typer.BadParameter(f"{', '.join(ROBOTS)}: got {name!r}", param_hint="--robot")
    if size or any(_numbers(distortion, 5, "--distortion")):
        raise typer.BadParameter("sets the camera: leave out --size and --distortion", param_hint="--robot")
    return ROBOTS[name]


def _record(
    simulate_with: Callable[[Callable[[str, int, int], None]], RecordingSummary], out: Path, as_json: bool
) -> None:
    """Simulate with a progress display, and print a summary of the recording in `out`."""
    began = time.monotonic()
    try:
        with _Bar() as bar:
            summary = simulate_with(bar.show)
    except (ValueError, FileExistsError) as error:
        console.print(f"[red]{error}[/]", highlight=False)
        raise typer.Exit(2) from error
    except KeyboardInterrupt as error:
        console.print("stopped; nothing was written (rendered images stay in the cache)")
        raise typer.Exit(130) from error
    took = time.monotonic() - began
    if as_json:
        sys.stdout.write(json.dumps({"out": str(out), "wall_s": round(took, 1), **asdict(summary)}) + "\n")
        return
    console.print(
        f"{summary.seconds:g} s, {summary.metres:.1f} m, {summary.laps:.2f} laps: {summary.images} images, "
        f"{summary.scans} scans, in {took:.0f} s",
        highlight=False,
    )
    for path in sorted(out.iterdir()):
        console.print(f"  {path}{'/' if path.is_dir() else ''}", highlight=False)


class _Bar:
    """Progress display on standard error, one line per stage; a stage without a count has no bar."""

    def __init__(self) -> None:
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=console,
        )
        self._stage = ""
        self._task: TaskID | None = None

    def __enter__(self) -> _Bar:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def show(self, stage: str, done: int, total: int) -> None:
        if stage != self._stage or self._task is None:
            self._stage = stage
            self._task = self._progress.add_task(stage, total=total or None)
        self._progress.update(self._task, completed=done, total=total or None)
