"""Write report.html of `bench paper`: the paper's tables and plots with our results. Parts of reports."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from html import escape
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from beamsplat.common.files.persist import write_atomically
from beamsplat.common.geometry.beams import project_beams
from beamsplat.tools.evaluation.depth_panels import colourize, label
from beamsplat.tools.report.scores import GroundTruth
from beamsplat.tools.report.svg import COLOURS, Curve, chart

STYLE = """body{font:14px/1.4 sans-serif;max-width:1200px;margin:2em auto;padding:0 1em;color:#222}
table{border-collapse:collapse;margin:.5em 0 1.5em}
td,th{border:1px solid #ccc;padding:3px 8px;text-align:right}
td:first-child,th:first-child{text-align:left}.p{color:#777}svg text{font-size:10px;fill:#333}
svg .t{font-size:13px;font-weight:bold}img{max-width:100%;margin:2px}.w{color:#a40}figure{margin:0 0 1.5em}
.k{display:inline-block;margin:0 1.6em .6em 0}.k b{display:block;font-size:22px}summary{cursor:pointer}
details{margin:1.5em 0}svg circle:hover{fill:#222}
pre{white-space:pre-wrap;font-size:11px}#map3d{background:#111;color:#ddd}"""

Row = dict[str, Any]
DEPTH_RANGE_M = (0.5, 8.0)  # of the colours of depth
TABLES: tuple[tuple[str, tuple[tuple[str, str, str], ...]], ...] = (
    ("Table I. Position RMSE (m), first poses aligned", (
        ("x", "position_rmse_xyz_m.0", ""), ("y", "position_rmse_xyz_m.1", ""),
        ("z", "position_rmse_xyz_m.2", ""),
        ("combined", "position_rmse_m", "position_rmse_m"), ("ATE", "ate_first_pose_rmse_m", ""),
        ("SE(3)-aligned", "ate_se3_rmse_m", ""), ("Sim(3)-aligned", "ate_sim3_rmse_m", ""),
        ("Sim(3) scale", "sim3_scale", ""), ("metric scale", "metric", ""),
        ("poses", "poses", ""),
    )),
    ("Table II. Orientation RMSE (rad)", (
        ("roll", "orientation_rmse_rpy_rad.0", ""), ("pitch", "orientation_rmse_rpy_rad.1", ""),
        ("yaw", "orientation_rmse_rpy_rad.2", "yaw_rmse_rad"), ("combined", "orientation_rmse_rad", ""),
    )),
    ("Table III. Speed and load", (
        ("FPS of the whole system", "fps", "fps"), ("poses per s", "poses_per_s", ""),
        ("CPU load %", "cpu_load_percent", "cpu_load_percent"), ("CPU s per image", "cpu_s_per_image", ""),
        ("keyframes per s", "keyframes_per_s", ""), ("latency p50 ms", "keyframe_latency_p50_ms", ""),
        ("p95 ms", "keyframe_latency_p95_ms", ""), ("memory MB", "peak_rss_mb", ""),
        ("link bytes", "link_bytes", ""),
    )),
    ("Table IV. Depth RMSE (m) at the beams; over all truth pixels", (
        ("scaled", "depth_rmse_scaled_m", "depth_rmse_scaled_m"),
        ("unscaled", "depth_rmse_unscaled_m", "depth_rmse_unscaled_m"),
        ("dense, scaled", "depth_dense_rmse_scaled_m", ""),
        ("dense, unscaled", "depth_dense_rmse_unscaled_m", ""),
        ("images", "depth_frames", ""),
    )),
    ("The map (not in the paper)", (
        ("PSNR off the path dB", "psnr_offpath_db", ""), ("SSIM", "ssim_offpath", ""),
        ("depth L1 m", "depth_l1_offpath_m", ""), ("F-score 5 cm", "fscore_5cm", ""),
        ("refined: PSNR dB", "refined_psnr_offpath_db", ""), ("SSIM", "refined_ssim_offpath", ""),
        ("depth L1 m", "refined_depth_l1_offpath_m", ""), ("F-score 5 cm", "refined_fscore_5cm", ""),
        ("PSNR at keyframes dB", "psnr_keyframes_db", ""),
        ("Gaussians", "gaussians", ""),
    )),
)  # fmt: skip


def write_report(path: Path, report: dict[str, Any], truth: GroundTruth) -> None:
    """Write the report on the paper's configurations as one HTML file that includes its images.

    Args:
        path: file to write.
        report: result of `report_of_runs`; configurations without `plots` appear only in the tables.
        truth: ground truth of the recording, which also provides the camera images.
    """
    rows: list[Row] = report["configurations"]
    drawn = [row for row in rows if "plots" in row]
    body = [f"<h1>The paper's configurations on {escape(report['data'])}</h1>", _preface(report)]
    body += [table(title, columns, rows) for title, columns in TABLES]
    body += [_pairs(report["pairs"])]
    body += ["<h2>Maps and trajectories</h2>", *_trajectories(drawn)]
    body += ["<h2>Errors over time</h2>", *errors_over_time(drawn), "<h2>Depth</h2>", depth_scale()]
    body += [part for row in drawn for part in depth_figures(row, truth)]
    body += [
        "<h2>Camera image and render</h2>",
        *(part for row in drawn for part in render_figures(row, truth)),
    ]
    write_page(path, "bench paper", body)


def write_page(path: Path, title: str, body: list[str]) -> None:
    """Write an HTML page with our style."""
    head = f"<head><meta charset='utf-8'><title>{escape(title)}</title><style>{STYLE}</style></head>"
    page = f"<!doctype html><html lang='en'>{head}<body>{''.join(body)}</body></html>"
    write_atomically(path, page.encode())


def _preface(report: dict[str, Any]) -> str:
    lines = [f"Run live, as processes, on {report['cores']} CPU cores.",
             "Grey figures are from the paper (Gazebo house, i9-12 and RTX 4090)."]  # fmt: skip
    for row in report["configurations"]:
        if row["status"] != "ok":
            lines.append(f"<span class=w>{escape(row['name'])} did not run: {escape(row['status'])}</span>")
        elif row["advice"]:
            lines.append(f"{escape(row['name'])}: {escape(row['depth_source'])} ({escape(row['advice'])})")
    return "<p>" + "<br>".join(lines) + "</p>"


def table(title: str, columns: tuple[tuple[str, str, str], ...], rows: list[Row]) -> str:
    """Return a table with one line per run; a column is (heading, key, key of the paper's figure)."""
    head = "".join(f"<th>{escape(name)}</th>" for name, _, _ in columns)
    lines = []
    for row in rows:
        cells = "".join(_cell(row, key, paper) for _, key, paper in columns)
        lines.append(f"<tr><td>{escape(_name(row))}</td>{cells}</tr>")
    return f"<h2>{escape(title)}</h2><table><tr><th></th>{head}</tr>{''.join(lines)}</table>"


def _name(row: Row) -> str:
    """Return title and seed of a row; after the title, the substitute for a missing depth network if any."""
    stand_in = " [" + row["depth_source"] + "]" if row["advice"] else ""
    seed = "" if row["seed"] is None else f", seed {row['seed']}"
    return f"{row['title']}{stand_in}{seed}"


def _cell(row: Row, key: str, paper_key: str) -> str:
    name, _, index = key.partition(".")
    value = row.get(name)
    if index and value is not None:
        value = value[int(index)]
    paper = row["paper"].get(paper_key)
    reference = f" <span class=p>{paper:g}</span>" if paper is not None else ""
    return f"<td>{_text(value)}{reference}</td>"


def _text(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _pairs(pairs: list[Row]) -> str:
    keys = ("cpu_load_ratio", "cpu_s_per_located_image_ratio", "fps_ratio", "position_ratio")
    head = "".join(f"<th>{key.replace('_', ' ')}</th>" for key in keys)
    lines = "".join(
        f"<tr><td>{escape(p['lidar'])} / {escape(p['camera'])}</td>"
        + "".join(f"<td>{_text(p[key])}</td>" for key in keys)
        + "</tr>"
        for p in pairs
    )
    note = "<p>The paper: 1024 / 1549 = 0.66 of the CPU load, a saving of 34 %.</p>"
    return f"<h2>Lidar against camera</h2><table><tr><th></th>{head}</tr>{lines}</table>{note}"


def _trajectories(rows: list[Row]) -> list[str]:
    out = []
    for row in rows:
        p = row["plots"]
        curves = [
            Curve("truth", p["true"][:, :2, 3], "#222", dashed=True),
            Curve(row["name"], p["found"][:, :2, 3], COLOURS[1]),
        ]
        out.append(chart(_name(row), "x m", "y m", curves, equal=True))
        if p["above"] is not None:
            out.append(figure(p["above"], f"{_name(row)}: top view of the map without its ceiling"))
    return out


def errors_over_time(rows: list[Row]) -> list[str]:
    """Return charts of the position error and of the depth error at the beams."""
    position, depth = [], []
    for number, row in enumerate(rows):
        p, tint = row["plots"], COLOURS[number % len(COLOURS)]
        if len(p["stamps_ns"]):
            error = np.linalg.norm(p["found"][:, :3, 3] - p["true"][:, :3, 3], axis=1)
            seconds = (p["stamps_ns"] - p["stamps_ns"][0]) * 1e-9
            position.append(Curve(row["name"], np.column_stack([seconds, error]), tint))
        series = row["depth_series"]
        stamps = np.array(series["stamps_ns"], dtype=np.int64)
        for name, dashed in (("scaled_m", False), ("unscaled_m", True)):
            if len(stamps):
                values = np.array([np.nan if v is None else v for v in series[name]])
                points = np.column_stack([(stamps - stamps[0]) * 1e-9, values])
                depth.append(Curve(f"{row['name']} {name[:-2]}", points, tint, dashed))
    with_lidar = [c for c in position if not c.name.endswith("-camera")]
    charts = [chart("Position error", "s", "m", position), chart("Depth RMSE at the beams", "s", "m", depth)]
    if 0 < len(with_lidar) < len(position):  # in one chart with the others they would be flat
        charts.insert(1, chart("Position error, with lidar", "s", "m", with_lidar))
    return charts


def depth_scale() -> str:
    """Return the colour scale of the depth images as HTML."""
    ramp = np.geomspace(*DEPTH_RANGE_M, 400).astype(np.float32)
    bar = _img(np.repeat(colourize(ramp[None], *DEPTH_RANGE_M), 12, axis=0), "colour scale of depth")
    low, high = DEPTH_RANGE_M
    text = f"logarithmic; the middle is {(low * high) ** 0.5:.1f} m. Black: unknown."
    return f"<p>Depth: {low:g} m {bar} {high:g} m ({text})</p>"


def depth_figures(row: Row, truth: GroundTruth) -> list[str]:
    """Return up to two times of a run as HTML: camera image with beams, estimated and fused depth."""
    fused, estimates = row["plots"]["fused"], row["plots"]["estimates"]
    stamps, out = sorted(fused), []
    for stamp_ns in stamps[len(stamps) // 3 :: max(len(stamps) // 2, 1)][:2]:
        rgb = _rgb(truth, stamp_ns)
        if rgb is None:
            continue
        h, w = fused[stamp_ns].shape
        shown = cv2.resize(cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), (w, h), interpolation=cv2.INTER_AREA)
        beams = _draw_beams(shown, truth, stamp_ns, h / rgb.shape[0])
        estimate = estimates.get(stamp_ns)
        before = np.full((h, w), np.nan, np.float32) if estimate is None else estimate.astype(np.float32)
        after = colourize(fused[stamp_ns].astype(np.float32), *DEPTH_RANGE_M)
        source = colourize(before, *DEPTH_RANGE_M)
        tiles = [label(shown, f"camera, {beams} lidar beams"), label(source, "depth source"),
                 label(after, "after fusion with the beams")]  # fmt: skip
        out.append(figure(np.hstack(tiles), f"{_name(row)}, {_seconds(row, stamp_ns)}"))
    return out


def _draw_beams(shown: np.ndarray, truth: GroundTruth, stamp_ns: int, scale: float) -> int:
    """Draw the lidar returns into an image, in the colours of depth; return their number."""
    beams = truth.drive.beams_at(stamp_ns)
    uv, z, _ = project_beams(beams, truth.drive.undistort.pinhole, truth.drive.T_body_camera)
    tints: Iterable[np.ndarray] = ()
    if len(z):
        tints = colourize(z[:, None].astype(np.float32), *DEPTH_RANGE_M)[:, 0]
    for (u, v), tint in zip(uv * scale, tints):
        cv2.circle(shown, (round(u), round(v)), 1, tuple(int(k) for k in tint), -1)
    return len(z)


def render_figures(row: Row, truth: GroundTruth) -> list[str]:
    """Return renders of the map as HTML, beside the camera's images and the true views off the path."""
    out = []
    for stamp_ns, jpeg in row["plots"]["previews"]:
        render = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        rgb = _rgb(truth, stamp_ns)
        if render is None or rgb is None:
            continue
        size = (render.shape[1], render.shape[0])
        camera = cv2.resize(cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), size, interpolation=cv2.INTER_AREA)
        both = np.hstack([label(camera, "camera"), label(render, "the map from there")])
        out.append(figure(both, f"{_name(row)}, {_seconds(row, stamp_ns)}"))
    for pair in row["plots"]["offpath"]:
        bgr = cv2.cvtColor(pair, cv2.COLOR_RGB2BGR)
        out.append(
            figure(bgr, f"{_name(row)}: where the robot has not been. Left: the truth. Right: the map")
        )
    return out


def _seconds(row: Row, stamp_ns: int) -> str:
    """Return a stamp as seconds since the first pose of a run."""
    stamps_ns = row["plots"]["stamps_ns"]
    return f"{(stamp_ns - stamps_ns[0]) * 1e-9:.1f} s" if len(stamps_ns) else f"{stamp_ns * 1e-9:.1f} s"


def _rgb(truth: GroundTruth, stamp_ns: int) -> np.ndarray | None:
    numbers = {image.stamp_ns: i for i, image in enumerate(truth.drive.images)}
    return truth.drive.rgb(numbers[stamp_ns]) if stamp_ns in numbers else None


def figure(bgr: np.ndarray, caption: str) -> str:
    """Return an image BGR uint8 [H, W, 3] with its caption as HTML, at most 1000 px wide."""
    if bgr.shape[1] > 1000:
        size = (1000, round(bgr.shape[0] * 1000 / bgr.shape[1]))
        bgr = cv2.resize(bgr, size, interpolation=cv2.INTER_AREA)
    return f"<figure>{_img(bgr, caption)}<figcaption>{escape(caption)}</figcaption></figure>"


def _img(bgr: np.ndarray, text: str) -> str:
    data = base64.b64encode(cv2.imencode(".jpg", bgr, (cv2.IMWRITE_JPEG_QUALITY, 80))[1].tobytes()).decode()
    return f"<img src='data:image/jpeg;base64,{data}' alt='{escape(text, quote=True)}'>"
