"""Simulates a complete recording: images, scans, odometry and ground truth, in one folder."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from beamsplat.tools.simulator import store
from beamsplat.tools.simulator import writer as w
from beamsplat.tools.simulator.actors import ActorPath, choose_actor_paths
from beamsplat.tools.simulator.changes import changes_json
from beamsplat.tools.simulator.clearance_grid import ClearanceGrid
from beamsplat.tools.simulator.drive_log import simulate_lidar
from beamsplat.tools.simulator.frames import (
    FrameRenderer,
    FrameSpec,
    build_actors,
    lap_start,
    load_frame,
    render_frames,
)
from beamsplat.tools.simulator.lidar_records import (
    Progress,
    RecordingSummary,
    TruthLog,
    lidar_records,
    transforms,
    write_lidar_truth,
)
from beamsplat.tools.simulator.path import DrivePath, MotionLimits
from beamsplat.tools.simulator.ray_caster import RayCaster
from beamsplat.tools.simulator.settings import START_NS, SimulationSettings
from beamsplat.tools.simulator.truth import DepthViews, decode_depth, surface_points, write_extra_views
from beamsplat.tools.simulator.world import get_world, world_key

SURFACE_VIEWS = 160  # maximum number of depth maps, evenly over the lap, that define the seen surface


def simulate(
    settings: SimulationSettings, out: Path, *, jobs: int, replace: bool, progress: Progress
) -> RecordingSummary:
    """Simulate a recording and write the folder `out`, which appears only when all files are complete.

    Args:
        settings: all settings of the recording.
        out: the folder.
        jobs: number of processes that render images.
        replace: whether an existing folder is replaced.
        progress: called with the name of the stage and the numbers of finished and of all parts.

    Raises:
        ValueError: a setting or the scene cannot be used.
        FileExistsError: `out` exists and `replace` is False.
    """
    if out.exists() and not replace:
        raise FileExistsError(f"{out} exists: choose another folder, or replace this one with --force")
    progress("preparing the scene (first time: about half a minute)", 0, 0)
    world = get_world(
        settings.seed, settings.scene, lambda stage: progress(stage, 0, 0), settings.rearrangement
    )
    drive = DrivePath(world.route_m, MotionLimits(), start=lap_start(settings.drive_seed))
    duration = _duration(settings, drive)
    caster = RayCaster.of(world.mesh)
    space = ClearanceGrid(world.mesh, caster)
    rng = np.random.default_rng([settings.drive_seed, 0x4D])
    actor_paths = choose_actor_paths(space, drive, caster, settings.people + settings.carts, duration, rng)
    with store.atomic_folder(out, replace=replace) as folder:
        streams: list[Iterator[w.BagRecord]] = [transforms(settings, duration)]
        images, views = 0, 0
        if not settings.lidar_only:
            spec = frame_spec(settings, actor_paths)
            times = _image_times(settings, drive, duration)
            images = len(times)
            in_lap = [round(t % drive.lap_s, 6) for t in times]
            unique = sorted(set(in_lap))
            paths = render_frames(spec, unique, jobs, lambda i, n: progress("rendering images", i, n))
            path_of = dict(zip(unique, paths))
            _write_image_truth(folder, settings, times, [path_of[t] for t in in_lap])
            views = _write_views(folder, settings, spec, space, unique, paths, progress)
            streams.append(_images(settings, times, [path_of[t] for t in in_lap]))
        log = TruthLog()
        actors = build_actors(world, tuple(actor_paths), settings.people, settings.drive_seed)
        steps = simulate_lidar(
            world.mesh,
            caster,
            drive,
            settings.lidar,
            settings.wheels,
            seed=settings.drive_seed,
            duration_s=duration,
            actors=actors,
        )
        scans = round(duration * settings.lidar.rate_hz)
        streams.append(lidar_records(settings, steps, log, lambda i: progress("scanning", i, scans)))
        camera = not settings.lidar_only
        messages = w.write_bag(folder / "bag", streams, settings.layout, camera=camera)
        write_lidar_truth(folder, settings, log)
        if settings.rearrangement is not None:
            (folder / "changes.json").write_text(json.dumps(changes_json(world.changes), indent=1) + "\n")
    metres = drive.length_m * duration / drive.lap_s
    return RecordingSummary(
        duration, duration / drive.lap_s, metres, images, len(log.scan_stamps_ns), messages, views
    )


def _duration(settings: SimulationSettings, drive: DrivePath) -> float:
    if settings.laps is not None:
        whole = settings.laps * drive.lap_s
        return whole if settings.seconds is None else min(whole, settings.seconds)
    return drive.lap_s if settings.seconds is None else settings.seconds


def frame_spec(settings: SimulationSettings, actor_paths: list[ActorPath]) -> FrameSpec:
    """Return the inputs that determine the frames of a recording; its world must already be in the cache."""
    name = f"{world_key(settings.seed, settings.scene, settings.rearrangement)}.npz"
    return FrameSpec(
        str(store.cache_root() / "worlds" / name),
        settings.drive_seed,
        settings.camera,
        tuple(actor_paths),
        settings.people,
        settings.faults.exposure_changes,
    )


def _image_times(settings: SimulationSettings, drive: DrivePath, duration_s: float) -> list[float]:
    """Return the times of all images in seconds; times since the lap start are equal in all laps."""
    camera = settings.camera
    per_lap = int(np.floor((drive.lap_s - camera.phase_s) * camera.rate_hz)) + 1
    offsets = [round(camera.phase_s + k / camera.rate_hz, 6) for k in range(per_lap)]
    laps = int(np.ceil(duration_s / drive.lap_s))
    times = [lap * drive.lap_s + offset for lap in range(laps) for offset in offsets if offset < drive.lap_s]
    # Laps take whole seconds, so `time % lap_s` restores the time of the lap exactly.
    return [round(t, 6) for t in times if t < duration_s]


def _stamp(settings: SimulationSettings, time_s: float) -> int:
    """Return the stamp in nanoseconds of the image at `time_s`, with the camera's clock offset."""
    return START_NS + round(time_s * 1e6) * 1000 + round(settings.faults.clock_offset_ms * 1e6)


def _images(settings: SimulationSettings, times_s: list[float], paths: list[Path]) -> Iterator[w.BagRecord]:
    rng = np.random.default_rng([settings.drive_seed, 0x4A, 1])
    layout, received = settings.layout, 0
    for time_s, path in zip(times_s, paths):
        stamp = _stamp(settings, time_s)
        lag = int(1e9 * layout.image_delay_s + rng.exponential(2.5e6))
        received = max(received + 1000, START_NS + round(time_s * 1e9) + lag)
        image = w.image_bytes(stamp, load_frame(path).jpeg, layout)
        yield w.BagRecord(received, layout.image_topic, image)
        info = w.camera_info_bytes(stamp, settings.camera, layout)
        yield w.BagRecord(received + 100, layout.camera_info_topic, info)


def _write_image_truth(
    folder: Path, settings: SimulationSettings, times_s: list[float], paths: list[Path]
) -> None:
    (folder / "depth_gt").mkdir()
    has_dynamic_objects = settings.people + settings.carts > 0
    if has_dynamic_objects:
        (folder / "moving_masks").mkdir()
    for k, (time_s, path) in enumerate(zip(times_s, paths)):
        name = f"{_stamp(settings, time_s)}.png"
        if k % settings.truth_every == 0:
            (folder / "depth_gt" / name).write_bytes(load_frame(path).depth_png.tobytes())
        if has_dynamic_objects:
            mask = load_frame(path).mask_png
            if len(mask):
                (folder / "moving_masks" / name).write_bytes(mask.tobytes())


def _write_views(
    folder: Path,
    settings: SimulationSettings,
    spec: FrameSpec,
    space: ClearanceGrid,
    times_s: list[float],
    paths: list[Path],
    progress: Progress,
) -> int:
    """Write the held-out views and the points of the ground-truth surface; return the number of views."""
    if not times_s:
        return 0
    frame_renderer = FrameRenderer(spec)
    step = max(1, -(-len(times_s) // SURFACE_VIEWS))
    chosen = list(range(0, len(times_s), step))
    depth_views = DepthViews(
        np.stack([frame_renderer.camera_pose(times_s[k]) for k in chosen]),
        np.stack([decode_depth(load_frame(paths[k]).depth_png) for k in chosen]),
        settings.camera.K,
        settings.camera.distortion,
    )
    rng = np.random.default_rng([settings.drive_seed, 0x56])
    count = write_extra_views(
        folder / "extra_views",
        frame_renderer,
        space,
        depth_views,
        np.array(times_s),
        settings.extra_views,
        rng,
        lambda i, n: progress("views off the path", i, n),
    )
    progress("sampling the seen surface", 0, 0)
    scene = frame_renderer.renderer.scene
    points, colours = surface_points(scene, depth_views, settings.surface_points, frame_renderer.gain, rng)
    w.write_ply(folder / "gt_surface.ply", points, colours)
    return count
