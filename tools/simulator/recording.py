"""A whole recording: the drive, its pictures, its scans, and the truth, written to a folder at one stroke."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.tools.simulator import store
from beamsplat.tools.simulator import writer as w
from beamsplat.tools.simulator.cast import Caster
from beamsplat.tools.simulator.drive_log import Step, simulate_lidar
from beamsplat.tools.simulator.freespace import FreeSpace
from beamsplat.tools.simulator.movers import Walk, choose_walks
from beamsplat.tools.simulator.path import Drive, Limits
from beamsplat.tools.simulator.settings import START_NS, Simulation
from beamsplat.tools.simulator.shots import Shoot, Studio, build_cast, load_shot, render_all, start_of
from beamsplat.tools.simulator.truth import Seen, decode_depth, surface_points, write_extra_views
from beamsplat.tools.simulator.world import World, get_world, world_key

Progress = Callable[[str, int, int], None]  # stage, done, of how many
SURFACE_VIEWS = 160


@dataclass(frozen=True)
class Summary:
    """What has been written."""

    seconds: float
    laps: float
    metres: float
    images: int
    scans: int
    messages: int
    extra_views: int


@dataclass
class _Log:
    """What the lidar stream leaves behind for the truth files."""

    scan_stamps_ns: list[int] = field(default_factory=list)
    moving: list[np.ndarray] = field(default_factory=list)
    through_glass: list[np.ndarray] = field(default_factory=list)
    stamps_ns: list[np.ndarray] = field(default_factory=list)
    truth: list[np.ndarray] = field(default_factory=list)


def simulate(settings: Simulation, out: Path, *, jobs: int, replace: bool, progress: Progress) -> Summary:
    """Writes the recording; `out` appears only when it is complete.

    Raises:
        ValueError: a setting or the scene cannot be used; the text names it.
        FileExistsError: `out` exists and `replace` is not given.
    """
    if out.exists() and not replace:
        raise FileExistsError(f"{out} exists: choose another folder, or replace it with --force")
    progress("preparing the scene (first time: about half a minute)", 0, 0)
    world = get_world(settings.seed, settings.scene, lambda stage: progress(stage, 0, 0))
    drive = Drive(world.route_m, Limits(), start=start_of(settings.seed))
    duration = _duration(settings, drive)
    caster = Caster.of(world.mesh)
    space = FreeSpace(world.mesh, caster)
    rng = np.random.default_rng([settings.seed, 0x4D])
    walks = choose_walks(space, drive, caster, settings.people + settings.carts, duration, rng)
    with store.whole_folder(out, replace=replace) as folder:
        streams: list[Iterator[w.Record]] = [_static_tf(settings)]
        topics = ["/tf_static", "/tf", "/odom", "/scan"]
        images, views = 0, 0
        if not settings.lidar_only:
            shoot = _shoot(settings, walks)
            times = _image_times(settings, drive, duration)
            images = len(times)
            in_lap = [round(t % drive.lap_s, 6) for t in times]
            unique = sorted(set(in_lap))
            paths = render_all(shoot, unique, jobs, lambda i, n: progress("rendering pictures", i, n))
            path_of = dict(zip(unique, paths))
            _write_picture_truth(folder, settings, times, [path_of[t] for t in in_lap])
            views = _write_views(folder, settings, shoot, space, unique, paths, progress)
            streams.append(_images(settings, times, [path_of[t] for t in in_lap]))
            topics += ["/camera/image_raw/compressed", "/camera/camera_info"]
        log = _Log()
        cast = build_cast(world, tuple(walks), settings.people, settings.seed)
        steps = simulate_lidar(
            world.mesh,
            caster,
            drive,
            settings.lidar,
            settings.wheels,
            seed=settings.seed,
            duration_s=duration,
            cast=cast,
        )
        scans = round(duration * settings.lidar.rate_hz)
        streams.append(_lidar_records(settings, steps, log, lambda i: progress("scanning", i, scans)))
        messages = w.write_bag(folder / "bag", streams, topics)
        _write_lidar_truth(folder, settings, log, drive)
    metres = drive.length_m * duration / drive.lap_s
    return Summary(duration, duration / drive.lap_s, metres, images, len(log.scan_stamps_ns), messages, views)


def _duration(settings: Simulation, drive: Drive) -> float:
    if settings.laps is not None:
        whole = settings.laps * drive.lap_s
        return whole if settings.seconds is None else min(whole, settings.seconds)
    return drive.lap_s if settings.seconds is None else settings.seconds


def _shoot(settings: Simulation, walks: list[Walk]) -> Shoot:
    name = f"{world_key(settings.seed, settings.scene)}.npz"
    return Shoot(
        str(store.cache_root() / "worlds" / name),
        settings.seed,
        settings.camera,
        tuple(walks),
        settings.people,
        settings.faults.exposure_changes,
    )


def _image_times(settings: Simulation, drive: Drive, duration_s: float) -> list[float]:
    """Seconds of all images; those of one lap repeat at the same times in the next."""
    camera = settings.camera
    per_lap = int(np.floor((drive.lap_s - camera.phase_s) * camera.rate_hz)) + 1
    offsets = [round(camera.phase_s + k / camera.rate_hz, 6) for k in range(per_lap)]
    laps = int(np.ceil(duration_s / drive.lap_s))
    times = [lap * drive.lap_s + offset for lap in range(laps) for offset in offsets if offset < drive.lap_s]
    # Seconds come back from a whole number of laps without rounding: laps are whole seconds long.
    return [round(t, 6) for t in times if t < duration_s]


def _stamp(settings: Simulation, time_s: float) -> int:
    """The stamp the camera gives an image, its clock's fault included."""
    return START_NS + round(time_s * 1e6) * 1000 + round(settings.faults.clock_offset_ms * 1e6)


def _static_tf(settings: Simulation) -> Iterator[w.Record]:
    links = [(w.BASE, w.LASER, settings.lidar.T_body_lidar)]
    if not settings.lidar_only:
        published = settings.faults.published(settings.camera.T_body_camera)
        links.insert(0, (w.BASE, w.CAMERA, published))
    yield w.Record(START_NS, "/tf_static", w.tf_bytes(START_NS, links))


def _images(settings: Simulation, times_s: list[float], paths: list[Path]) -> Iterator[w.Record]:
    rng = np.random.default_rng([settings.seed, 0x4A, 1])
    received = 0
    for time_s, path in zip(times_s, paths):
        stamp = _stamp(settings, time_s)
        lag = int(28e6 + rng.exponential(2.5e6))
        received = max(received + 1000, START_NS + round(time_s * 1e9) + lag)
        yield w.Record(received, "/camera/image_raw/compressed", w.image_bytes(stamp, load_shot(path).jpeg))
        yield w.Record(received + 100, "/camera/camera_info", w.camera_info_bytes(stamp, settings.camera))


def _lidar_records(
    settings: Simulation, steps: Iterator[Step], log: _Log, progress: Callable[[int], None]
) -> Iterator[w.Record]:
    """Scans, odometry and tf in order of receipt, while truth is put aside."""
    rng = np.random.default_rng([settings.seed, 0x4A, 2])
    period_ns = round(1e9 / settings.lidar.rate_hz)
    waiting: list[tuple[int, int, w.Record]] = []
    last, number = {"/scan": 0, "/odom": 0}, 0

    def put(topic: str, received: int, data: bytes) -> int:
        nonlocal number
        received = max(received, last.get(topic, 0) + 1000)
        last[topic] = received
        heapq.heappush(waiting, (received, number, w.Record(received, topic, data)))
        number += 1
        return received

    for index, step in enumerate(steps):
        log.scan_stamps_ns.append(step.stamp_ns)
        log.moving.append(np.packbits(step.moving))
        log.through_glass.append(np.packbits(step.through_glass))
        log.stamps_ns.append(step.odometry_stamps_ns)
        log.truth.append(step.truth_poses)
        odometry = step.odometry
        lags = 2e6 + rng.exponential(3e5, len(odometry.pose) + 1)
        for k, (stamp, T) in enumerate(zip(step.odometry_stamps_ns.tolist(), se2_to_se3(odometry.pose))):
            data = w.odometry_bytes(stamp, T, float(odometry.speed_m_s[k]), float(odometry.turn_rad_s[k]))
            received = put("/odom", stamp + int(lags[k]), data)
            put("/tf", received + 100, w.tf_bytes(stamp, [(w.ODOM, w.BASE, T)]))
        scan_lag = period_ns + int(5e6 + 4 * (lags[-1] - 2e6))
        put("/scan", step.stamp_ns + scan_lag, w.scan_bytes(step.stamp_ns, step.ranges_m, settings.lidar))
        # Later steps count odometry after the end of this one: what was received before is complete.
        while waiting and waiting[0][0] <= step.stamp_ns + period_ns:
            yield heapq.heappop(waiting)[2]
        progress(index + 1)
    while waiting:
        yield heapq.heappop(waiting)[2]


def _write_picture_truth(folder: Path, settings: Simulation, times_s: list[float], paths: list[Path]) -> None:
    (folder / "depth_gt").mkdir()
    movers = settings.people + settings.carts > 0
    if movers:
        (folder / "moving_masks").mkdir()
    for k, (time_s, path) in enumerate(zip(times_s, paths)):
        name = f"{_stamp(settings, time_s)}.png"
        if k % settings.truth_every == 0:
            (folder / "depth_gt" / name).write_bytes(load_shot(path).depth_png.tobytes())
        if movers:
            mask = load_shot(path).mask_png
            if len(mask):
                (folder / "moving_masks" / name).write_bytes(mask.tobytes())


def _write_views(
    folder: Path,
    settings: Simulation,
    shoot: Shoot,
    space: FreeSpace,
    times_s: list[float],
    paths: list[Path],
    progress: Progress,
) -> int:
    """Off-path views and the seen surface; returns the number of views."""
    if not times_s:
        return 0
    studio = Studio(shoot)
    step = max(1, -(-len(times_s) // SURFACE_VIEWS))
    chosen = list(range(0, len(times_s), step))
    seen = Seen(
        np.stack([studio.pose(times_s[k]) for k in chosen]),
        np.stack([decode_depth(load_shot(paths[k]).depth_png) for k in chosen]),
        settings.camera.K,
        settings.camera.distortion,
    )
    rng = np.random.default_rng([settings.seed, 0x56])
    count = write_extra_views(
        folder / "extra_views",
        studio,
        space,
        seen,
        np.array(times_s),
        settings.extra_views,
        rng,
        lambda i, n: progress("views off the path", i, n),
    )
    progress("sampling the seen surface", 0, 0)
    scene = studio.renderer.scene
    points, colours = surface_points(scene, seen, settings.surface_points, studio.gain, rng)
    w.write_ply(folder / "gt_surface.ply", points, colours)
    return count


def _write_lidar_truth(folder: Path, settings: Simulation, log: _Log, drive: Drive) -> None:
    w.write_camera_json(folder / "camera.json", settings.camera, settings.lidar, settings.faults)
    poses = np.concatenate(log.truth) if log.truth else np.zeros((0, 3))
    stamps = np.concatenate(log.stamps_ns) if log.stamps_ns else np.zeros(0, np.int64)
    w.write_tum(folder / "groundtruth.txt", stamps, se2_to_se3(poses))
    np.savez_compressed(
        folder / "beams.npz",
        stamp_ns=np.array(log.scan_stamps_ns, dtype=np.int64),
        moving=_unpack(log.moving, settings.lidar.beams),
        through_glass=_unpack(log.through_glass, settings.lidar.beams),
    )


def _unpack(rows: list[np.ndarray], beams: int) -> np.ndarray:
    """bool [S, B]."""
    if not rows:
        return np.zeros((0, beams), np.bool_)
    return np.unpackbits(np.stack(rows), axis=1)[:, :beams].astype(np.bool_)


def open_drive(seed: int, scene: str | None = None) -> tuple[World, Caster, Drive]:
    """What `drive_log.simulate_lidar` needs, for long lidar-only drives without a recording."""
    world = get_world(seed, scene)
    return world, Caster.of(world.mesh), Drive(world.route_m, Limits(), start=start_of(seed))
