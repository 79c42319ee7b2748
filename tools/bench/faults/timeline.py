"""Picture of a campaign: faults, times without localization, restarts and findings over time."""

from __future__ import annotations

from html import escape

from beamsplat.tools.report.svg import COLOURS

_LEFT_PX, _WIDTH_PX, _ROW_PX = 190, 1200, 16


def timeline(
    end_s: float,
    faults: list[tuple[str, float, float, str]],
    gaps: list[tuple[float, float, str]],
    restarts: list[tuple[float, str, bool]],
    findings: list[tuple[float, str]],
) -> str:
    """Return an SVG document with one row per kind of fault, and rows for what they caused.

    Args:
        end_s: length of the campaign.
        faults: (kind, start s, end s, text).
        gaps: (start s, end s, cause): without localization.
        restarts: (time s, process, whether a fault asked for it).
        findings: (time s, text).
    """
    scale = (_WIDTH_PX - _LEFT_PX - 10) / max(end_s, 1.0)
    kinds = sorted({kind for kind, *_ in faults})
    rows: list[tuple[str, str, list[tuple[float, float, str]]]] = [
        (kind, COLOURS[i % len(COLOURS)], [(a, b, text) for k, a, b, text in faults if k == kind])
        for i, kind in enumerate(kinds)
    ]
    rows.append(("without localization", "#000", gaps))
    rows.append(("restarts by a fault", "#888", [(t, t, name) for t, name, expected in restarts if expected]))
    rows.append(("other restarts", "#c0c", [(t, t, name) for t, name, expected in restarts if not expected]))
    rows.append(("findings", "#d00", [(t, t, text) for t, text in findings]))
    height = (len(rows) + 2) * _ROW_PX
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH_PX} {height}" width="{_WIDTH_PX}" '
        f'height="{height}" font-family="sans-serif" font-size="10">'
        '<rect width="100%" height="100%" fill="#fff"/>'
    ]
    for number, (label, colour, bars) in enumerate(rows):
        y = number * _ROW_PX + 4
        parts.append(f'<text x="4" y="{y + 10}">{escape(label)}</text>')
        parts.append(f'<line x1="{_LEFT_PX}" y1="{y + 14}" x2="{_WIDTH_PX}" y2="{y + 14}" stroke="#eee"/>')
        for began, ended, text in bars:
            x, width = _LEFT_PX + began * scale, max((ended - began) * scale, 2.0)
            parts.append(f'<rect x="{x:.1f}" y="{y}" width="{width:.1f}" height="12" fill="{colour}">'
                         f"<title>{began:.1f} s: {escape(text)}</title></rect>")  # fmt: skip
    step_s = next((s for s in (10, 30, 60, 120, 300, 600) if end_s / s <= 14), 1800)
    y = len(rows) * _ROW_PX + 14
    for mark in range(0, int(end_s) + 1, step_s):
        x = _LEFT_PX + mark * scale
        parts.append(f'<text x="{x:.1f}" y="{y}" text-anchor="middle">{mark // 60}:{mark % 60:02d}</text>')
    return "".join([*parts, "</svg>"])
