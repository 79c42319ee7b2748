"""Write report.html of one drive, for its user: pictures first, then charts, then all figures."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.tools.report.html import (
    TABLES,
    Row,
    depth_figures,
    depth_scale,
    errors_over_time,
    figure,
    render_figures,
    table,
    write_page,
)
from beamsplat.tools.report.map_view import map_section
from beamsplat.tools.report.scores import GroundTruth
from beamsplat.tools.report.svg import COLOURS, Curve, chart

# (key, factor, format, what it is), in the order of interest; what a drive has no figure for is left out.
_KEY_FIGURES: tuple[tuple[str, float, str, str], ...] = (
    ("position_rmse_m", 100.0, "{:.1f} cm", "position error during the drive (RMSE)"),
    ("psnr_keyframes_db", 1.0, "{:.1f} dB", "map against the camera, at keyframes"),
    ("psnr_offpath_db", 1.0, "{:.1f} dB", "map against the truth, off the path"),
    ("depth_rmse_scaled_m", 100.0, "{:.0f} cm", "depth error at the beams (RMSE)"),
    ("keyframe_latency_p50_ms", 1e-3, "{:.1f} s", "from a keyframe's image to the map (median)"),
    ("fps", 1.0, "{:.1f} /s", "images through the whole system"),
    ("gaussians", 1.0, "{:.0f}", "Gaussians"),
    ("peak_rss_mb", 1.0, "{:.0f} MB", "memory of all processes"),
)


def write_drive_report(path: Path, report: dict[str, Any], truth: GroundTruth) -> None:
    """Write the report on a single drive as one HTML file that includes its images and the map in 3D.

    Args:
        path: file to write.
        report: result of `single_run_report`.
        truth: the recording with its images; ground truth is compared where it has any.
    """
    (row,) = report["configurations"]
    plots = row["plots"]
    head = [f"<h1>{escape(report['data'])}, mapped</h1>", _summary(row, report["cores"])]
    body = []
    if plots["above"] is not None:
        body.append(
            figure(plots["above"], "The map from above, without its ceiling, and the way of the robot")
        )
    body += ["<h2>The map and the camera</h2>", *render_figures(row, truth)]
    body += ["<h2>Depth</h2>", depth_scale(), *depth_figures(row, truth)]
    has_truth = row.get("position_rmse_m") is not None  # else `true` is the trajectory that was found
    body += ["<h2>Trajectory</h2>", _trajectory(plots, has_truth)]
    body += ["<h2>Errors over time</h2>", *errors_over_time([row])] if has_truth else []
    tables = "".join(table(title, columns, [row]) for title, columns in TABLES)
    body.append(f"<details><summary>All figures</summary>{tables}</details>")
    if plots.get("map") is not None:
        used_bytes = sum(len(part.encode()) for part in (*head, *body))
        head.append(map_section(plots["map"], plots["found"][:, :2, 3], used_bytes))
    write_page(path, f"{report['data']}, mapped", [*head, *body])


def _summary(row: Row, cores: int) -> str:
    found = row["plots"]["found"]
    length_m = float(np.linalg.norm(np.diff(found[:, :3, 3], axis=0), axis=1).sum()) if len(found) else 0.0
    cards = [_card(f"{length_m:.0f} m", "driven")]
    for key, factor, form, what in _KEY_FIGURES:
        value = row.get(key)
        if value is not None and np.isfinite(value):
            cards.append(_card(form.format(factor * value), what))
    return f"<p>{''.join(cards)}</p><p>Live, as processes, on {cores} CPU cores.</p>"


def _card(value: str, what: str) -> str:
    return f"<span class=k><b>{escape(value)}</b>{escape(what)}</span>"


def _trajectory(plots: dict[str, Any], has_truth: bool) -> str:
    curves = [Curve("BeamSplat", plots["found"][:, :2, 3], COLOURS[1])]
    if has_truth:
        curves.insert(0, Curve("truth", plots["true"][:, :2, 3], "#222", dashed=True))
    return chart("Trajectory", "x m", "y m", curves, equal=True)
