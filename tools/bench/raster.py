"""`bench raster`: time of rendering with L1 loss and backward pass in a synthetic room.

The reference is a renderer in plain PyTorch.
"""

from __future__ import annotations

import os
import resource
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.layout import COLOUR, MEAN, OPACITY, PARAMS, QUAT, SCALE
from beamsplat.common.raster.rasterizer import Rasterizer
from beamsplat.services.mapping.kernels import photometric_and_depth
from beamsplat.services.mapping.warm import warm

SIZES = ((320, 240), (640, 480))
Log = Callable[[str], None]


def synthetic_room(gaussians: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return the Gaussians of a furnished room of 6 x 5 x 2.5 m, and a camera pose in one of its corners.

    Gaussians are discs of 1-4 cm on walls, floor, ceiling and boxes. Neighbours in memory are neighbours on a
    surface, as in maps that the mapper builds.

    Returns:
        Parameters of the Gaussians float32 [14, capacity], of which the first `gaussians` columns are used
        (rows: `beamsplat.common.raster.layout`), and T_camera_map float64 [4, 4].
    """
    rng = np.random.default_rng(seed)
    faces = _faces(rng)
    area = np.array([np.linalg.norm(np.cross(u, v)) for _, u, v in faces])
    counts = np.floor(gaussians * area / area.sum()).astype(int)
    counts[0] += gaussians - counts.sum()
    params = np.zeros((PARAMS, -(-gaussians // 16) * 16), np.float32)
    at = 0
    for (origin, u, v), count in zip(faces, counts):
        where = rng.random((count, 2))
        where = where[np.lexsort((where[:, 0], np.floor(where[:, 1] * 20)))]
        to = slice(at, at + count)
        params[MEAN : MEAN + 3, to] = (origin + where[:, :1] * u + where[:, 1:] * v).T
        params[QUAT : QUAT + 4, to] = _turn_z_to(np.cross(u, v))[:, None]
        colour = 0.5 + 0.4 * np.sin(3.0 * params[MEAN : MEAN + 3, to] + rng.uniform(0, 6, (3, 1)))
        params[COLOUR : COLOUR + 3, to] = colour + rng.normal(0, 0.05, (3, count))
        at += count
    params[SCALE : SCALE + 2, :gaussians] = np.log(rng.uniform(0.01, 0.04, (2, gaussians)))
    params[SCALE + 2, :gaussians] = np.log(0.004)
    params[OPACITY, :gaussians] = rng.normal(1.0, 1.0, gaussians)
    viewpoint, target = np.array([0.5, 0.5, 1.3]), np.array([6.0, 4.4, 0.9])
    forward = (target - viewpoint) / np.linalg.norm(target - viewpoint)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    T_camera_map = np.eye(4)
    T_camera_map[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    T_camera_map[:3, 3] = -T_camera_map[:3, :3] @ viewpoint
    return params, T_camera_map


def _faces(rng: np.random.Generator) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return the faces of the room and of eight boxes in it: (corner, side vector, side vector), metres."""

    def box(low: np.ndarray, high: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        x, y, z = np.diag(high - low)
        return [(low, x, y), (low + z, x, y), (low, x, z), (low + y, x, z), (low, y, z), (low + x, y, z)]

    faces = box(np.zeros(3), np.array([6.0, 5.0, 2.5]))
    for _ in range(8):
        low = np.array([rng.uniform(1.5, 5.0), rng.uniform(0.5, 4.0), 0.0])
        faces += box(low, low + rng.uniform([0.3, 0.3, 0.4], [0.9, 0.9, 1.2]))
    return faces


def _turn_z_to(normal: np.ndarray) -> np.ndarray:
    """Return the quaternion (w, x, y, z) that rotates z to the direction of the normal."""
    n = normal / np.linalg.norm(normal)
    quat = np.array([1.0 + n[2], -n[1], n[0], 0.0]) if n[2] > -0.999 else np.array([0.0, 1.0, 0.0, 0.0])
    return quat / np.linalg.norm(quat)


def bench_raster(gaussians: int = 50_000, repeats: int = 15, log: Log = lambda text: None) -> dict[str, Any]:
    """Time the rasterizers on a synthetic room; return one entry of `cases` per renderer and image size.

    Times are wall and CPU time in ms: medians and minima over `repeats` runs, in which one and two threads
    alternate. The reference is timed once.
    """
    warm()
    params, T_camera_map = synthetic_room(gaussians)
    cases = []
    for width, height in SIZES:
        camera = RasterCamera(0.9 * width, 0.9 * width, 0.5 * width - 0.5, 0.5 * height - 0.5, width, height)
        cases += _cpu_cases(params, gaussians, camera, T_camera_map, repeats)
        log(f"{width}x{height}: {cases[-1]['total_ms']:.1f} ms with two threads; running the reference")
        cases.append(_reference_case(params, gaussians, camera, T_camera_map))
        fastest = min(case["cpu_ms"] for case in cases if case["width"] == width and case["backend"] == "cpu")
        cases[-1]["times_slower"] = cases[-1]["cpu_ms"] / fastest
    return {
        "cases": cases, "load_average": os.getloadavg()[0], "cores": os.cpu_count(),
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
    }  # fmt: skip


def _target(shape: tuple[int, ...]) -> np.ndarray:
    return np.random.default_rng(1).random(shape, dtype=np.float32)


def _cpu_cases(
    params: np.ndarray, count: int, camera: RasterCamera, T_camera_map: np.ndarray, repeats: int
) -> list[dict[str, Any]]:
    shape = (camera.height_px, camera.width_px)
    target = (_target((5, *shape)) * 255.0).astype(np.uint8)
    depth_mm = target[3].astype(np.uint16) * np.uint16(20)
    gradient, sums = np.empty((5, *shape), np.float32), np.empty((shape[0], 2))
    scale = np.float32(1.0 / gradient.size)
    teams = {threads: Rasterizer(threads) for threads in (1, 2)}
    times: dict[int, list[tuple[float, float, float]]] = {threads: [] for threads in teams}
    pairs = 0
    for repeat in range(repeats + 2):
        for threads, rasterizer in teams.items():
            cpu, start = time.process_time(), time.perf_counter()
            render = rasterizer.render(params, count, camera, T_camera_map)
            middle = time.perf_counter()
            rasterizer.team.run(
                photometric_and_depth, render.image, target[:3], depth_mm, target[4], np.zeros(6, np.float32),
                scale, scale, gradient, sums,
            )  # fmt: skip
            rasterizer.backward(render, gradient)
            end, pairs = time.perf_counter(), render.pairs
            rasterizer.release(render)
            if repeat >= 2:  # the first two allocate memory
                times[threads].append((middle - start, end - start, time.process_time() - cpu))
    for rasterizer in teams.values():
        rasterizer.close()
    return [_case("cpu", count, camera, threads, times[threads], pairs=pairs) for threads in teams]


def _case(
    backend: str,
    count: int,
    camera: RasterCamera,
    threads: int,
    times: list[tuple[float, float, float]],
    **more: Any,
) -> dict[str, Any]:
    forward, total, cpu = np.median(np.array(times), axis=0) * 1e3
    best = np.min(np.array(times), axis=0) * 1e3
    return {
        "gaussians": count, "width": camera.width_px, "height": camera.height_px, "backend": backend,
        "threads": threads, "forward_ms": float(forward), "total_ms": float(total), "cpu_ms": float(cpu),
        "best_total_ms": float(best[1]), "best_cpu_ms": float(best[2]), **more,
    }  # fmt: skip


def _reference_case(
    params: np.ndarray, count: int, camera: RasterCamera, T_camera_map: np.ndarray
) -> dict[str, Any]:
    """Time one run of the reference renderer (plain PyTorch, float32) on one thread; return its case."""
    import torch

    from beamsplat.services.mapping.renderers.protocol import make_renderer

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        times = [_torch_step(make_renderer("reference"), params, count, camera, T_camera_map, "cpu")]
    finally:
        torch.set_num_threads(threads)
    return _case("reference", count, camera, 1, times)


def _torch_step(
    renderer: Any, params: np.ndarray, count: int, camera: RasterCamera, T_camera_map: np.ndarray, device: str
) -> tuple[float, float, float]:
    """Render, compute the L1 loss and its gradient with a torch renderer, once; return the times in s.

    Returns:
        Wall time of rendering, wall time of everything, CPU time of everything.
    """
    import torch

    from beamsplat.common.raster.layout import GROUPS
    from beamsplat.services.mapping.renderers.protocol import Gaussians

    tensors = [torch.tensor(params[a:b, :count].T.copy(), device=device) for a, b in GROUPS.values()]
    tensors[3] = tensors[3].reshape(-1)
    gaussians = Gaussians(*(tensor.requires_grad_() for tensor in tensors))
    target = torch.from_numpy(_target((5, camera.height_px, camera.width_px))).to(device)
    wait = torch.cuda.synchronize if device == "cuda" else lambda: None
    wait()
    cpu, start = time.process_time(), time.perf_counter()
    view = renderer.render(gaussians, camera, T_camera_map)
    wait()
    middle = time.perf_counter()
    image = torch.cat([view.colour.permute(2, 0, 1), view.depth_m[None], view.alpha[None]])
    (image - target).abs().mean().backward()
    wait()
    return middle - start, time.perf_counter() - start, time.process_time() - cpu
