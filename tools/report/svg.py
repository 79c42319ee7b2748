"""Draw line charts as SVG text, without a plotting library. Values are shown under the pointer."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

import numpy as np

COLOURS = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#ff7f0e", "#17becf", "#8c564b")
_WIDTH, _HEIGHT, _EDGE = 560, 340, 46
_MARKS = 80  # points of a curve that show their values under the pointer


@dataclass(frozen=True)
class Curve:
    """A named line of a chart through points float64 [N, 2] (x, y); a NaN point interrupts the line."""

    name: str
    points: np.ndarray
    colour: str
    dashed: bool = False


def chart(title: str, x_label: str, y_label: str, curves: list[Curve], *, equal: bool = False) -> str:
    """Return a line chart as an SVG element, or an HTML paragraph "no data" if no curve has points.

    With `equal`, both axes have the same scale, as in maps.
    """
    parts = [c.points[np.all(np.isfinite(c.points), axis=1)] for c in curves]
    everything = np.concatenate(parts) if parts else np.zeros((0, 2))
    if not len(everything):
        return f"<p>{escape(title)}: no data</p>"
    low, high = np.percentile(everything, 0.5, axis=0), np.percentile(everything, 99.5, axis=0)
    if not equal:
        low, high = everything.min(axis=0), everything.max(axis=0)
        low[1] = min(low[1], 0.0)
    span = np.maximum(high - low, 1e-6)
    room = np.array([_WIDTH - 2 * _EDGE, _HEIGHT - 2 * _EDGE])
    scale = np.full(2, (room / span).min()) if equal else room / span

    def at(points: np.ndarray) -> np.ndarray:
        xy = (points - low) * scale
        return np.stack([_EDGE + xy[:, 0], _HEIGHT - _EDGE - xy[:, 1]], axis=1)

    out = [
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" width="{_WIDTH}" height="{_HEIGHT}" role="img">',
        f'<text x="{_WIDTH / 2}" y="16" text-anchor="middle" class="t">{escape(title)}</text>',
    ]
    out += _axes(low, low + room / scale, x_label, y_label)
    for number, curve in enumerate(curves):
        xy = at(curve.points)
        out += [*_line(curve, xy), *_marks(curve, xy, x_label, y_label)]
        y = 30 + 14 * number
        out.append(
            f'<line x1="{_WIDTH - 150}" y1="{y}" x2="{_WIDTH - 132}" y2="{y}" stroke="{curve.colour}"/>'
        )
        out.append(f'<text x="{_WIDTH - 128}" y="{y + 4}">{escape(curve.name)}</text>')
    return "".join([*out, "</svg>"])


def _line(curve: Curve, xy: np.ndarray) -> list[str]:
    """Return SVG polylines through points xy [N, 2] in px; each is thinned to about 1000 points."""
    good = np.all(np.isfinite(xy), axis=1)
    pieces = np.split(np.arange(len(xy)), np.flatnonzero(np.diff(good.astype(int)) != 0) + 1)
    dash = ' stroke-dasharray="5 3"' if curve.dashed else ""
    out = []
    for piece in pieces:
        if len(piece) < 2 or not good[piece[0]]:
            continue
        thin = xy[piece][:: max(len(piece) // 1000, 1)]
        text = " ".join(f"{x:.1f},{y:.1f}" for x, y in thin)
        out.append(f'<polyline points="{text}" fill="none" stroke="{curve.colour}"{dash}/>')
    return out


def _marks(curve: Curve, xy: np.ndarray, x_label: str, y_label: str) -> list[str]:
    """Return invisible circles at some points of a curve, at xy [N, 2] px, whose titles are their values."""
    good = np.flatnonzero(np.all(np.isfinite(xy), axis=1))
    out = ['<g fill="none" pointer-events="all">']
    for i in good[:: max(-(-len(good) // _MARKS), 1)]:
        (x, y), (value_x, value_y) = xy[i], curve.points[i]
        text = escape(f"{curve.name}: {x_label} {value_x:.4g}, {y_label} {value_y:.4g}")
        out.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4"><title>{text}</title></circle>')
    return [*out, "</g>"]


def _axes(low: np.ndarray, high: np.ndarray, x_label: str, y_label: str) -> list[str]:
    x0, x1, y0, y1 = _EDGE, _WIDTH - _EDGE, _HEIGHT - _EDGE, _EDGE
    out = [f'<rect x="{x0}" y="{y1}" width="{x1 - x0}" height="{y0 - y1}" fill="none" stroke="#999"/>']
    for k in range(5):
        share = k / 4
        x, y = x0 + share * (x1 - x0), y0 + share * (y1 - y0)
        vx, vy = low + share * (high - low)
        out.append(f'<text x="{x:.0f}" y="{y0 + 14}" text-anchor="middle">{vx:.3g}</text>')
        out.append(f'<text x="{x0 - 4}" y="{y:.0f}" text-anchor="end">{vy:.3g}</text>')
    out.append(f'<text x="{(x0 + x1) / 2}" y="{_HEIGHT - 12}" text-anchor="middle">{escape(x_label)}</text>')
    middle = (y0 + y1) / 2
    turn = f"rotate(-90 12 {middle})"
    out.append(f'<text x="12" y="{middle}" text-anchor="middle" transform="{turn}">{escape(y_label)}</text>')
    return out
