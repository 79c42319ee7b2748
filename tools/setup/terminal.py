"""Draw images and scans as text, for computers without a display."""

from __future__ import annotations

import cv2
import numpy as np
from rich.color import Color
from rich.style import Style
from rich.text import Text

_HALF = "▀"  # upper half in the foreground colour, lower half in the background colour
_CHARACTER = 2.0  # height of a character over its width
_RANGES_M = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)  # half widths of the scan view


def image_text(
    bgr: np.ndarray,  # uint8 [H, W, 3]
    columns: int,
) -> Text:
    """Return an image as coloured text, two pixels per character."""
    rows = max(round(bgr.shape[0] / bgr.shape[1] * columns / _CHARACTER), 1)
    small = cv2.resize(bgr, (columns, 2 * rows), interpolation=cv2.INTER_AREA)[..., ::-1]
    text = Text(no_wrap=True)
    for y in range(rows):
        for x in range(columns):
            upper, lower = (Color.from_rgb(*small[2 * y + i, x].tolist()) for i in (0, 1))
            text.append(_HALF, Style(color=upper, bgcolor=lower))
        text.append("\n")
    return text


def scan_text(
    points_m: np.ndarray,  # float [N, 2]: x forward, y left
    columns: int,
) -> Text:
    """Return a scan seen from above as text: forward is up, the lidar is the character ^.

    The half width of the view is the smallest of 1, 2, 4, ... 32 m that contains 90 % of the points.
    """
    half = columns // 2
    rows = round(half / _CHARACTER)
    far_m = float(np.quantile(np.abs(points_m), 0.9)) if len(points_m) else 1.0
    reach_m = next((r for r in _RANGES_M if r >= far_m), _RANGES_M[-1])
    cells = np.full((2 * rows + 1, 2 * half + 1), " ")
    row = np.round(rows - points_m[:, 0] / reach_m * rows).astype(int)
    column = np.round(half - points_m[:, 1] / reach_m * half).astype(int)
    seen = (row >= 0) & (row <= 2 * rows) & (column >= 0) & (column <= 2 * half)
    cells[row[seen], column[seen]] = "·"
    cells[rows, half] = "^"
    lines = ["".join(line).rstrip() for line in cells]
    return Text("\n".join([*lines, f"(from the centre to the edge: {reach_m:g} m)"]), no_wrap=True)
