"""`bench sites`: the lidar SLAM on large simulated office floors, also with look-alike corridors and losses.

The floors differ in their seeds; none of them was used to choose a setting of the SLAM.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from beamsplat.common.errors import UserError
from beamsplat.tools.bench.slam import measure_recording, run_beamsplat

# Options of `beamsplat simulate --site office`.
SITES: dict[str, tuple[str, ...]] = {
    "office": ("--seed", "101"),
    "office_lost": ("--seed", "102", "--lost", "3"),
    "aliased": ("--seed", "103", "--aliased"),
    "aliased_lost": ("--seed", "104", "--aliased", "--lost", "3"),
}
PEOPLE = 30
COLUMNS = (
    "site", "error, m", "online, m", "wrong closures", "revisits joined", "scans not ok",
    "CPU ms per scan, first tenth", "last tenth", "longest step, CPU ms", "memory, MB",
)  # fmt: skip


def bench_sites(
    out: Path, only: list[str] | None, size: str, distance_m: float, log: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Simulate the floors that `out` lacks, map them, and return accuracy and cost, one row per floor.

    Args:
        out: receives one folder per floor, with `recording` and `map` in it.
        only: names of the floors, see SITES; None = all.
        size: of each floor, as in the option --size of `simulate`.
        distance_m: driven on each floor.
        log: receives progress messages.

    Raises:
        UserError: a name is unknown, or a floor cannot be simulated or mapped.
    """
    unknown = [name for name in only or () if name not in SITES]
    if unknown:
        raise UserError(f"--only {unknown[0]}: unknown; known are {', '.join(SITES)}")
    rows = []
    for name in only or SITES:
        folder = out / f"{name}-{size}-{distance_m:g}m"
        recording = folder / "recording"
        if not recording.exists():
            log(f"{name}: simulating ...")
            site = ["--site", "office", "--lidar-only", "--size", size, "--distance-m", str(distance_m)]
            people = ["--movers", str(PEOPLE)]
            done = run_beamsplat(["simulate", "--out", str(recording), *site, *people, *SITES[name]])
            if done.returncode:
                raise UserError(f"{name}: {done.stderr.strip()}")
        truth = ["--groundtruth", str(recording / "groundtruth.txt")]
        row = measure_recording(name, recording / "bag", truth, folder / "map", True, log)
        if row is None:
            raise UserError(f"{name}: not mapped")
        rows.append(row)
    return rows


def markdown(rows: list[dict[str, Any]]) -> str:
    """Return the results of `bench_sites` as a Markdown table.

    Errors are ATE RMSE after the best rigid alignment, of the final and of the published trajectory.
    """
    lines = ["| " + " | ".join(COLUMNS) + " |", "|---" * len(COLUMNS) + "|"]
    for row in rows:
        cells = [
            row["name"],
            f"{row['ate_se3_rmse_m']:.3f}",
            f"{row['online_ate_se3_rmse_m']:.3f}",
            f"{row['loops_wrong']} of {row['loops_in_graph']}",
            f"{row.get('revisit_recall', float('nan')):.1%} of {row['revisits']}",
            f"{1.0 - row.get('scans_ok', 0) / row['scans']:.1%}",
            f"{row['cpu_ms_per_scan_first_tenth']:.1f}",
            f"{row['cpu_ms_per_scan_last_tenth']:.1f}",
            f"{row['step_max_cpu_ms']:.0f}",
            f"{row['peak_rss_mb']:.0f}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)
