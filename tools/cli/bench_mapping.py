"""Commands `beamsplat bench raster` and `bench map`: speed of the rasterizer, quality of the maps."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from beamsplat.common.engines.choice import EngineName
from beamsplat.common.errors import UserError
from beamsplat.tools.cli.options import writable

console = Console(stderr=True)
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object")]


def bench_raster(
    gaussians: Annotated[int, typer.Option(min=1000, help="Gaussians in the synthetic room")] = 50_000,
    repeats: Annotated[int, typer.Option(min=3, help="Timed runs; the median is reported")] = 15,
    as_json: JsonOption = False,
) -> None:
    """Measure forward, L1 loss and backward of the rasterizers with one and two threads, and of plain torch.

    Example: beamsplat bench raster --json
    """
    from beamsplat.tools.bench.raster import bench_raster as run

    result = run(gaussians, repeats, console.print)
    if as_json:
        print(json.dumps(result))
        return
    table = Table(
        "backend", "size", "Gaussians", "threads", "forward ms", "total ms", "CPU ms", "best total ms"
    )
    for case in result["cases"]:
        numbers = [f"{case[key]:.1f}" for key in ("forward_ms", "total_ms", "cpu_ms", "best_total_ms")]
        size = f"{case['width']}x{case['height']}"
        table.add_row(case["backend"], size, str(case["gaussians"]), str(case["threads"]), *numbers)
    Console().print(table)


def bench_map(
    data: Annotated[Path, typer.Argument(help="Folder with bag/, groundtruth.txt and held-out views")],
    prior: Annotated[
        str,
        typer.Option(help="Depth of the keyframes: field (fused), stixel (beams and floor) or truth"),
    ] = "field",
    source: Annotated[str, typer.Option(help="Depth source that fusion uses (with field)")] = "stixel",
    refine_s: Annotated[float, typer.Option(min=0.0, help="Refinement after the drive, in seconds")] = 60.0,
    count_cpu: Annotated[
        bool, typer.Option("--count-cpu", help="Count these as CPU seconds per thread: for busy machines")
    ] = False,
    threads: Annotated[int, typer.Option(min=1, help="Threads of the rasterizer")] = 2,
    distance_m: Annotated[float, typer.Option(min=0.01, help="Distance between keyframes")] = 0.25,
    angle_rad: Annotated[float, typer.Option(min=0.01, help="Rotation between keyframes")] = 0.22,
    refine_pose: Annotated[bool, typer.Option("--refine-pose", help="Let the mapper refine poses")] = False,
    refine_exposure: Annotated[
        bool, typer.Option("--refine-exposure", help="Let the mapper refine the exposure of each image")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the mapper")] = 0,
    jump: Annotated[
        bool,
        typer.Option("--jump", help="Misplace half of the keyframes by 1 m and 10 degrees until the end"),
    ] = False,
    settle_steps: Annotated[
        int, typer.Option(min=0, help="Steps at the end of the drive, before the first evaluation")
    ] = 0,
    engine: Annotated[
        EngineName, typer.Option(help="What computes the map: cpu, cuda, or auto (the GPU if there is one)")
    ] = "cpu",
    movers: Annotated[
        bool, typer.Option("--movers", help="Mask dynamic objects that the beams detect")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(callback=writable, help="Write images and the map (.ply) into this folder"),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Build a map from true poses; evaluate PSNR, SSIM and depth at held-out views, online and refined.

    Examples:

        beamsplat bench map drive --json

        beamsplat bench map drive --prior truth --refine-s 0 --jump --settle-steps 300
    """
    import cv2

    from beamsplat.services.mapping.engines.choice import make_engine
    from beamsplat.services.mapping.profiles import settings_for
    from beamsplat.tools.bench.fused_prior import DynamicObjectMasks, FusedDepthPrior
    from beamsplat.tools.bench.mapping import MapBenchSettings, run_bench

    cv2.setNumThreads(1)
    mapper_engine = make_engine(engine, threads)
    settings = settings_for(mapper_engine.identity.name)
    bench = MapBenchSettings(
        prior=prior, threads=threads, seed=seed, refine_s=refine_s, count_cpu=count_cpu, jump=jump,
        settle_steps=settle_steps, distance_m=distance_m, angle_rad=angle_rad,
        settings=replace(settings, refine_pose=refine_pose, refine_exposure=refine_exposure),
    )  # fmt: skip
    field = FusedDepthPrior(source) if prior == "field" else None
    masks = DynamicObjectMasks() if movers else None
    result = run_bench(data, bench, console.print, out, field, masks, mapper_engine)
    if as_json:
        print(json.dumps(result))
        return
    _print_scores(result)


def bench_gpu(
    out: Annotated[Path, typer.Option(callback=writable, help="Folder for gpu.json")],
    data: Annotated[
        Path | None, typer.Option(help="Recording with truth: also run `bench map` on it, with the GPU")
    ] = None,
    tile: Annotated[int, typer.Option(min=8, max=16, help="Side of the rasterizer's tiles, px: 8 or 16")] = 8,
    repeats: Annotated[int, typer.Option(min=10, help="Timed steps of each case")] = 100,
    as_json: JsonOption = False,
) -> None:
    """Measure the CUDA engine on this machine's GPU: correctness, determinism, ms a step, memory, a map.

    It needs no network, and a few minutes. gsplat is measured beside it where it is installed.

    Examples:

        beamsplat bench gpu --out out/gpu

        beamsplat bench gpu --out out/gpu --data recordings/house_a
    """
    from beamsplat.common.engines.choice import check_cuda

    if tile not in (8, 16):
        raise UserError(f"--tile {tile}: expected 8 or 16")
    check_cuda("mapping.engine")
    from beamsplat.common.raster.cuda.driver import CudaKernels
    from beamsplat.tools.bench.gpu import bench_gpu as run

    result = run(out, CudaKernels(tile), data, console.print, repeats=repeats)
    if as_json:
        print(json.dumps(result))
        return
    table = Table(
        "Gaussians", "size", "ms a step", "with SSIM", "forward ms", "kernels ms", "MB", "same bits"
    )
    for row in result["steps"]:
        times = (row[key] for key in ("step_ms", "step_with_ssim_ms", "forward_ms", "kernel_sum_ms"))
        size = f"{row['width']}x{row['height']}"
        same = "yes" if row["same_bits_twice"] else "NO"
        numbers = [f"{ms:.3f}" for ms in times]
        table.add_row(str(row["gaussians"]), size, *numbers, f"{row['peak_mb']:.0f}", same)
    screen = Console()
    screen.print(table)
    worst = ", ".join(f"{name} {value:.1e}" for name, value in result["correctness"].items())
    screen.print(f"against float64: {worst}")
    for prior in ("truth", "field"):
        if found := result.get(f"map_{prior}"):
            screen.print(f"bench map, depth {prior}:")
            _print_scores(found)
    screen.print(str(out / "gpu.json"))


def _print_scores(result: dict[str, Any]) -> None:
    table = Table("figure", "online", "refined")
    for key in result["online"]:
        shown = (result[part][key] for part in ("online", "refined"))
        table.add_row(key, *("-" if value is None else f"{value:.3f}" for value in shown))
    screen = Console()
    screen.print(table)
    for key in ("keyframes", "refused", "data_s", "wall_s", "cpu_s", "steps", "refine_steps", "peak_rss_mb"):
        screen.print(
            f"{key}: {result[key]:.1f}" if isinstance(result[key], float) else f"{key}: {result[key]}"
        )
