"""gsplat beside the CUDA engine: the same room, the same kind of step, with torch's fused Adam."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import Any

import torch

from beamsplat.common.raster.layout import GROUPS, NEAR_M
from beamsplat.tools.bench.raster import synthetic_room


def time_gsplat(count: int, width_px: int, height_px: int, repeats: int) -> dict[str, Any]:
    """Time gsplat's forward, backward and Adam step, ms, and the plain sum of its kernels' times.

    Returns:
        The figures, or `missing` with the reason.
    """
    row: dict[str, Any] = {"gaussians": count, "width": width_px, "height": height_px}
    if importlib.util.find_spec("gsplat") is None:
        return row | {"missing": "gsplat is not installed"}
    try:
        return row | _measure(count, width_px, height_px, repeats)
    except (ImportError, OSError, RuntimeError) as error:  # it builds its kernels with nvcc at the first use
        return row | {"missing": str(error).splitlines()[0][:200]}


def _measure(count: int, width_px: int, height_px: int, repeats: int) -> dict[str, Any]:
    from gsplat import rasterization

    params, T_camera_map = synthetic_room(count)
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    leaves = [
        torch.from_numpy(params[a:b, :count].T.copy()).cuda().requires_grad_() for a, b in GROUPS.values()
    ]
    mean, log_scale, quat, opacity, colour = leaves
    viewmat = torch.tensor(T_camera_map, device="cuda", dtype=torch.float32)[None].requires_grad_()
    focal = 0.9 * width_px  # gsplat's pixel centres are at one half
    intrinsics = [[focal, 0.0, 0.5 * width_px], [0.0, focal, 0.5 * height_px], [0.0, 0.0, 1.0]]
    K = torch.tensor(intrinsics, device="cuda")
    generator = torch.Generator().manual_seed(0)
    gradient = torch.randn(1, height_px, width_px, 5, generator=generator).cuda() / (5 * height_px * width_px)
    adam = torch.optim.Adam([{"params": [leaf], "lr": 1e-6} for leaf in leaves], eps=1e-15, fused=True)

    def step() -> None:
        image, alpha, _ = rasterization(
            mean, quat, log_scale.exp(), opacity[:, 0].sigmoid(), colour, viewmat, K[None],
            width_px, height_px, near_plane=NEAR_M, render_mode="RGB+D", packed=False,
        )  # fmt: skip
        torch.autograd.backward(
            [image, alpha], [gradient[..., :4].contiguous(), gradient[..., 4:].contiguous()]
        )
        adam.step()
        adam.zero_grad(set_to_none=True)
        viewmat.grad = None

    kernels_ms = kernel_times_ms(step)
    return {
        "step_ms": time_on_gpu_ms(step, repeats), "kernels_ms": dict(list(kernels_ms.items())[:14]),
        "kernel_sum_ms": round(sum(kernels_ms.values()), 4),
        "peak_mb": (torch.cuda.max_memory_allocated() - before) / 1e6,
    }  # fmt: skip


def time_on_gpu_ms(work: Callable[[], object], repeats: int) -> float:
    """Return the mean time of `work` on the GPU, ms."""
    first, last = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
    torch.cuda.synchronize()
    first.record()
    for _ in range(repeats):
        work()
    last.record()
    torch.cuda.synchronize()
    return float(first.elapsed_time(last)) / repeats


def kernel_times_ms(work: Callable[[], object], runs: int = 10) -> dict[str, float]:
    """Return the time of each kernel in `work`, ms, by name, the longest first."""
    from torch.profiler import ProfilerActivity, profile

    for _ in range(5):
        work()
    torch.cuda.synchronize()
    with profile(activities=[ProfilerActivity.CUDA]) as profiler:
        for _ in range(runs):
            work()
        torch.cuda.synchronize()
    found = {e.key[:60]: e.device_time_total / runs / 1e3 for e in profiler.key_averages()}
    return {name: round(ms, 4) for name, ms in sorted(found.items(), key=lambda item: -item[1]) if ms > 0.0}
