"""Generation of training data: one folder of samples per simulated home, in several processes."""

from __future__ import annotations

import json
import multiprocessing
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.services.depth.source import DepthSource, make_source
from beamsplat.tools.simulator.actors import ActorLighting, ActorPath, ActorSet, choose_actor_paths
from beamsplat.tools.simulator.render import SceneRenderer
from beamsplat.tools.simulator.shade import shading_tables
from beamsplat.tools.simulator.store import atomic_folder
from beamsplat.tools.training.carriers import random_sensors
from beamsplat.tools.training.drives import DriveScene, DriveSettings, TrainingDrive
from beamsplat.tools.training.homes import TrainingHome, build_training_home
from beamsplat.tools.training.motion import SMALL_VIEW, Motion, RobotMotion, hand_motion
from beamsplat.tools.training.sample_files import SUFFIX, Carrier, TrainingSample, save_sample

FORMAT = 1  # of the samples; raised when the simulated drives or the inputs change
_HELDOUT_SEED = 500_000  # homes for evaluation have other seeds than homes for training
_PEOPLE = 0.4  # probability of people in a home
_HAND_ANCHORS = 4  # places of a home at which the hand-held sensors move
_ROBOT_STEP = (0.18, float(np.radians(9.0)))  # m, rad between images
_HAND_STEP = (0.045, float(np.radians(2.5)))
_HAND_EVERY = 3  # images per sample
_HAND_S = 25.0  # longest time at a place
_METERED, _METERED_PERCENTILE = (0.3, 0.5), 70  # exposed light of the percentile in a well exposed image


@dataclass(frozen=True)
class HomeTask:
    """Everything that determines the samples of one home."""

    seed: int
    samples: int  # by each carrier
    source: str  # depth source beside `stixel`, "" = none
    source_options: dict[str, Any] = field(default_factory=dict)
    folder: str = ""  # where they are written


def home_tasks(
    out: Path, kind: str, homes: int, seed: int, samples: int, source: str, source_options: dict[str, Any]
) -> list[HomeTask]:
    """Return the tasks of all homes of a kind: "train" or "heldout"."""
    first = 1_000_000 * seed + (_HELDOUT_SEED if kind == "heldout" else 0)
    return [
        HomeTask(first + k, samples, source, source_options, str(out / kind / f"home_{k:04d}"))
        for k in range(homes)
    ]


def generate_homes(
    tasks: list[HomeTask], jobs: int, progress: Callable[[int, int], None]
) -> list[dict[str, Any]]:
    """Generate the homes that do not exist yet; return the record (home.json) of each home.

    A home's folder appears when it is complete, so an interrupted run continues with the next home.

    Args:
        tasks: the homes.
        jobs: number of processes.
        progress: receives the number of finished and of all homes.

    Raises:
        UserError: a home cannot be generated.
    """
    missing = [task for task in tasks if not (Path(task.folder) / "home.json").is_file()]
    for folder in {Path(task.folder).parent for task in missing}:
        for incomplete in folder.glob(".home_*.part"):  # of a process that was killed
            shutil.rmtree(incomplete, ignore_errors=True)
    done = len(tasks) - len(missing)
    progress(done, len(tasks))
    for failure in _run(missing, jobs):
        if failure:
            raise UserError(failure)
        done += 1
        progress(done, len(tasks))
    return [json.loads((Path(task.folder) / "home.json").read_text()) for task in tasks]


def _run(tasks: list[HomeTask], jobs: int) -> Iterator[str]:
    if jobs <= 1 or len(tasks) <= 1:
        yield from map(_generate, tasks)
        return
    context = multiprocessing.get_context("spawn")
    with context.Pool(min(jobs, len(tasks)), maxtasksperchild=8) as pool:
        yield from pool.imap_unordered(_generate, tasks)


def _generate(task: HomeTask) -> str:
    """Generate a home; return "", or why that is not possible."""
    started_s = time.process_time()
    try:
        generate_home(task, build_training_home(task.seed), started_s)
    except (ValueError, OSError) as error:
        return f"the home of seed {task.seed}: {error}"
    return ""


def generate_home(task: HomeTask, home: TrainingHome, started_s: float | None = None) -> dict[str, Any]:
    """Write the samples of a home, and home.json with their numbers and the CPU time; return that record.

    The same task and home yield the same samples. `started_s` is the value of `time.process_time` from which
    the CPU time of the home counts; None: now.

    Raises:
        OSError: the disk is full.
        UserError: the depth source cannot be created.
    """
    cv2.setNumThreads(1)
    started_s = time.process_time() if started_s is None else started_s
    folder = Path(task.folder)
    with atomic_folder(folder, replace=True) as part:
        counts: dict[str, int] = {}
        people = 0
        for sample, scene in home_samples(task, home):
            number = counts.get(sample.carrier, 0)
            counts[sample.carrier] = number + 1
            people = len(scene.actors.bodies) if scene.actors is not None else 0
            save_sample(part / f"{sample.carrier}_{number:03d}{SUFFIX}", sample)
        size = sum(file.stat().st_size for file in part.iterdir())
        record = {
            "seed": task.seed, "robot": counts.get("robot", 0), "hand": counts.get("hand", 0),
            "people": people, "bytes": size, "cpu_s": round(time.process_time() - started_s, 2),
        }  # fmt: skip
        (part / "home.json").write_text(json.dumps(record) + "\n")
    return record


def home_samples(task: HomeTask, home: TrainingHome) -> Iterator[tuple[TrainingSample, DriveScene]]:
    """Yield the samples of a home: of a robot, then hand-held, `task.samples` of each at most."""
    rng = np.random.default_rng([task.seed, 0x53])
    scene = _scene(home, rng)
    stixel = make_source("stixel")
    network = make_source(task.source, task.source_options) if task.source else None
    sources: tuple[DepthSource | None, ...] = (
        (stixel, stixel, stixel, None) if network is None else (network, network, stixel, None)
    )
    gain = _metered_gain(scene, rng)
    robot = DriveSettings(*_ROBOT_STEP, images=task.samples + 1, sample_every=1)
    motion: Motion = RobotMotion(home.drive, float(rng.uniform(0.0, home.drive.lap_s)))
    yield from _drive(scene, motion, "robot", gain, sources, robot, rng)
    left = task.samples
    for anchor in range(4 * _HAND_ANCHORS):
        if left <= 0:
            return
        # Shares of equal size; where images are left out, further places make up for them.
        share = min(left, -(-task.samples // _HAND_ANCHORS))
        hand = DriveSettings(*_HAND_STEP, images=_HAND_EVERY * share + 1, sample_every=_HAND_EVERY)
        place = np.random.default_rng([task.seed, 0x48, anchor])
        motion = hand_motion(home.drive, scene.renderer, _HAND_S, place)
        for pair in _drive(scene, motion, "hand", gain, sources, hand, place):
            left -= 1
            yield pair


def _drive(
    scene: DriveScene, motion: Motion, carrier: Carrier, gain: float, sources: tuple[DepthSource | None, ...],
    settings: DriveSettings, rng: np.random.Generator,
) -> Iterator[tuple[TrainingSample, DriveScene]]:  # fmt: skip
    drive = TrainingDrive(scene, motion, random_sensors(carrier, rng), gain, sources, rng)
    for sample in drive.samples(settings):
        yield sample, scene


def _scene(home: TrainingHome, rng: np.random.Generator) -> DriveScene:
    """Return the home with a renderer, and in some homes with one or two people."""
    world = home.world
    tables = shading_tables(world.mesh, world.atlas, world.light)
    renderer = SceneRenderer(home.caster, tables)
    count = int(rng.integers(1, 3)) if rng.random() < _PEOPLE else 0
    paths = _people(home, count, rng)
    if not paths:
        return DriveScene(home, renderer, None, None)
    actors = ActorSet.of(paths, len(paths), world.texture_size_m, rng)
    lighting = ActorLighting(actors, home.caster, tables, world.atlas, world.lights)
    return DriveScene(home, renderer, actors, lighting)


def _people(home: TrainingHome, count: int, rng: np.random.Generator) -> list[ActorPath]:
    """Return the paths of up to `count` people: fewer if the home has no room for them."""
    while count > 0:
        try:
            return choose_actor_paths(
                home.space, home.drive, home.caster, count, home.drive.lap_s, rng, tries=40
            )
        except ValueError:
            count -= 1
    return []


def _metered_gain(scene: DriveScene, rng: np.random.Generator) -> float:
    """Return the gain that exposes small views along the robot's path well."""
    drive = scene.home.drive
    mount = random_sensors("robot", np.random.default_rng(0)).T_body_camera
    times = np.linspace(0.0, drive.lap_s, 8, endpoint=False)
    views = [scene.renderer.render(drive.transform_at(t) @ mount, SMALL_VIEW).radiance for t in times]
    level = float(np.percentile(np.stack(views).mean(axis=-1), _METERED_PERCENTILE))
    return float(rng.uniform(*_METERED)) / max(level, 1e-6)
