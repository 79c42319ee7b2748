"""`bench gpu`: the CUDA engine on a machine with a GPU: correctness, determinism, times, memory, a whole map.

The result is one JSON file, written again after each part. A step is what the mapper does per optimiser step:
forward pass, losses, backward pass and Adam, replayed as one CUDA graph.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from beamsplat.common.files.persist import make_folder, write_atomically
from beamsplat.common.geometry.transforms import make_transform, so3_exp
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.cuda.device_map import DeviceMap
from beamsplat.common.raster.cuda.source import Kernels
from beamsplat.common.raster.cuda.targets import pack_targets
from beamsplat.common.raster.cuda.training import TrainingView
from beamsplat.common.raster.layout import GROUPS
from beamsplat.common.raster.optimiser import learning_rates
from beamsplat.services.mapping.renderers.cuda import CudaRenderer
from beamsplat.services.mapping.renderers.protocol import (
    DifferentiableRenderer,
    Gaussians,
    make_renderer,
)
from beamsplat.tools.bench.gpu_gsplat import kernel_times_ms, time_gsplat, time_on_gpu_ms
from beamsplat.tools.bench.raster import synthetic_room

COUNTS = (50_000, 200_000, 1_000_000)
SIZES = ((640, 480), (320, 240))
# The limits that the figures are compared with, ms a step at 640x480 on a large GPU (H100).
STEP_LIMITS_MS = {50_000: 0.3, 200_000: 0.5, 1_000_000: 1.3}
_STEPS_HASHED = 20
_PAIRS_EACH = 10  # room for pairs of splat and tile per Gaussian
Log = Callable[[str], None]


def bench_gpu(
    out: Path,
    kernels: Kernels,
    data: Path | None,
    log: Log,
    counts: tuple[int, ...] = COUNTS,
    sizes: tuple[tuple[int, int], ...] = SIZES,
    repeats: int = 100,
) -> dict[str, Any]:
    """Measure the CUDA engine and write the figures to `out`/gpu.json; return them.

    Args:
        kernels: compiled for the device.
        data: recording with truth for `bench map` (see `load_dataset`); None leaves that part out.
        log: receives progress messages.
        counts: numbers of Gaussians in the synthetic room.
        sizes: image sizes, px.
        repeats: timed steps of each case.
    """
    make_folder(out)
    result: dict[str, Any] = {"device": kernels.description, "torch": torch.__version__, "steps": []}

    def save() -> None:
        write_atomically(out / "gpu.json", (json.dumps(result, indent=1) + "\n").encode())

    log("gradients against the reference in float64")
    result["correctness"] = compare_with_reference(kernels)
    save()
    for count in counts:
        for size in sizes:
            log(f"{count} Gaussians, {size[0]}x{size[1]}")
            result["steps"].append(measure_step(kernels, count, *size, repeats))
            save()
    if data is not None:
        for prior in ("truth", "field"):
            log(f"bench map {data}, depth: {prior}")
            result[f"map_{prior}"] = _map(data, prior, kernels, log)
            save()
    if kernels.device.type == "cuda":
        log("gsplat, where it is installed (it compiles its kernels at the first use)")
        result["gsplat"] = [time_gsplat(count, *size, repeats // 2) for count in counts for size in sizes]
        save()
    return result


def compare_with_reference(kernels: Kernels) -> dict[str, float]:
    """Return relative errors of gradients and pose, and the lowest PSNR (dB) of three random scenes."""
    errors: dict[str, list[float]] = {}
    for seed, size, count in ((0, (61, 47), 400), (1, (64, 48), 1500), (2, (97, 33), 3000)):
        rng = np.random.default_rng(seed)
        camera, T_camera_map, arrays = _random_scene(rng, count, *size)
        weights = torch.as_tensor(rng.normal(size=(5, size[1], size[0])))
        reference, ours = make_renderer("reference"), CudaRenderer(kernels)
        found = [
            _gradients(renderer, arrays, camera, T_camera_map, weights, dtype)
            for renderer, dtype in ((reference, torch.float64), (ours, torch.float32))
        ]
        (true_image, *true), (image, *measured) = found
        error = float(np.mean((image - true_image) ** 2))
        errors.setdefault("psnr_db", []).append(-10.0 * np.log10(max(error, 1e-20)))
        for name, a, b in zip((*GROUPS, "pose"), measured, true):
            length = max(float(np.linalg.norm(b)), 1e-12)
            errors.setdefault(name, []).append(float(np.linalg.norm(a - b)) / length)
    psnr_db = min(errors.pop("psnr_db"))
    return {"psnr_db": psnr_db, **{name: max(values) for name, values in errors.items()}}


def _random_scene(
    rng: np.random.Generator, count: int, width_px: int, height_px: int
) -> tuple[RasterCamera, np.ndarray, list[np.ndarray]]:
    T_camera_map = make_transform(so3_exp(rng.normal(size=3)), rng.normal(size=3))
    focal = rng.uniform(0.7, 1.2) * width_px
    camera = RasterCamera(focal, 1.02 * focal, 0.47 * width_px, 0.52 * height_px, width_px, height_px)
    z = rng.uniform(-1.0, 6.0, count)
    points = np.column_stack([rng.uniform(-0.8, 0.8, (count, 2)) * np.abs(z)[:, None], z])
    mean = (points - T_camera_map[:3, 3]) @ T_camera_map[:3, :3]
    log_scale = np.log(rng.uniform(0.01, 0.15, (count, 3)))
    quat, opacity = rng.normal(size=(count, 4)), rng.normal(size=count) * 2.0
    arrays = [mean, log_scale, quat, opacity, rng.uniform(0.0, 1.0, (count, 3))]
    return camera, T_camera_map, [array.astype(np.float32).astype(np.float64) for array in arrays]


def _gradients(
    renderer: DifferentiableRenderer,
    arrays: list[np.ndarray],
    camera: RasterCamera,
    T_camera_map: np.ndarray,
    weights: torch.Tensor,
    dtype: torch.dtype,
) -> list[np.ndarray]:
    """Return the image [5, H, W], and the gradients of the parameter groups and the pose of one loss."""
    tensors = [torch.tensor(array, dtype=dtype, requires_grad=True) for array in arrays]
    tangent = torch.zeros(6, dtype=dtype, requires_grad=True)
    shown = renderer.render(Gaussians(*tensors), camera, T_camera_map, None, tangent)
    image = torch.cat([shown.colour.permute(2, 0, 1), shown.depth_m[None], shown.alpha[None]]).cpu().double()
    (weights * image + 0.1 * (image - 0.5) ** 2).mean().backward()
    gradients = [tensor.grad for tensor in (*tensors, tangent)]
    return [image.detach().numpy(), *(g.numpy().astype(np.float64) for g in gradients if g is not None)]


def measure_step(kernels: Kernels, count: int, width_px: int, height_px: int, repeats: int) -> dict[str, Any]:
    """Time the steps on the synthetic room; hash the map after the same steps, twice."""
    on_gpu = kernels.device.type == "cuda"
    if on_gpu:
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
    params, T_camera_map = synthetic_room(count)
    device_map = DeviceMap(kernels, keyframes=1, capacity=count, pairs=_PAIRS_EACH * count)
    device_map.gaussians.append(params[:, :count])
    view = _prepared(device_map, T_camera_map, width_px, height_px)
    start = device_map.gaussians.read()
    hashes = [_hash_after_steps(device_map, view, start) for _ in range(2)]
    row: dict[str, Any] = {
        "gaussians": count, "width": width_px, "height": height_px, "tile": kernels.source.tile,
        "same_bits_twice": hashes[0] == hashes[1], "hash": hashes[0], "overflowed": device_map.grow(),
        "step_ms": _time_ms(kernels, lambda: view.run(False), repeats),
        "step_with_ssim_ms": _time_ms(kernels, lambda: view.run(True), repeats),
        "forward_ms": _time_ms(kernels, view.forward, repeats),
    }  # fmt: skip
    if on_gpu:
        row["kernels_ms"] = kernel_times_ms(lambda: view.step(True))
        row["kernel_sum_ms"] = round(sum(row["kernels_ms"].values()), 4)
        row["peak_mb"] = (torch.cuda.max_memory_allocated() - before) / 1e6
    return row


def _prepared(device_map: DeviceMap, T_camera_map: np.ndarray, width_px: int, height_px: int) -> TrainingView:
    """Return a view whose next steps are on a random image from the pose of the room's camera."""
    rng = np.random.default_rng(1)
    shape = (height_px, width_px)
    focal = 0.9 * width_px
    camera = RasterCamera(focal, focal, 0.5 * width_px - 0.5, 0.5 * height_px - 0.5, width_px, height_px)
    targets = pack_targets(
        rng.integers(0, 256, (3, *shape)).astype(np.uint8), rng.integers(500, 6000, shape).astype(np.uint16),
        rng.integers(0, 256, shape).astype(np.uint8), None,
        np.sort(rng.integers(0, width_px * height_px, 300)).astype(np.int32),
        rng.uniform(0.5, 6.0, 300).astype(np.float32),
    )  # fmt: skip
    view = device_map.training_view(width_px, height_px)
    # A thousandth of the usual rates: the scene stays what it is while it is timed.
    view.set_learning_rates(learning_rates(2e-6, 6e-6, 2e-6, 3e-5, 5e-6))
    view.load(torch.from_numpy(targets).to(device_map.kernels.device))
    view.begin(camera, np.linalg.inv(T_camera_map))
    return view


def _hash_after_steps(device_map: DeviceMap, view: TrainingView, start: dict[str, np.ndarray]) -> str:
    """Return the hash of the Gaussians after some steps from `start`, and set them back."""
    gaussians = device_map.gaussians
    everything = slice(0, gaussians.count)
    gaussians.write(everything, start)
    for step in range(_STEPS_HASHED):
        view.run(step % 3 == 0)
    content = b"".join(array.tobytes() for array in gaussians.read().values())
    gaussians.write(everything, start)
    return hashlib.sha256(content).hexdigest()[:16]


def _time_ms(kernels: Kernels, work: Callable[[], object], repeats: int) -> float:
    """Return the mean time of `work` on the device, ms."""
    for _ in range(3):
        work()
    if kernels.device.type == "cuda":
        return time_on_gpu_ms(work, repeats)
    begun = time.perf_counter()
    for _ in range(repeats):
        work()
    return (time.perf_counter() - begun) * 1e3 / repeats


def _map(data: Path, prior: str, kernels: Kernels, log: Log) -> dict[str, Any]:
    from beamsplat.services.mapping.engines.cuda import CudaEngine
    from beamsplat.services.mapping.profiles import settings_for
    from beamsplat.tools.bench.fused_prior import FusedDepthPrior
    from beamsplat.tools.bench.mapping import MapBenchSettings, run_bench

    bench = MapBenchSettings(prior=prior, refine_s=20.0, threads=2, settings=settings_for("cuda"))
    field = FusedDepthPrior("stixel") if prior == "field" else None
    return run_bench(data, bench, log, None, field, engine=CudaEngine(kernels))
