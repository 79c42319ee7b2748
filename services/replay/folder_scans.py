"""Scans in plain files: rows of a CSV file, or one PCD point cloud per revolution."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.common.errors import UserError, reason

_REQUIRED = ("angle_min_rad", "angle_increment_rad", "range_min_m", "range_max_m")
_OPTIONAL = ("time_increment_s", "scan_time_s")
# Largest angle between a point and the direction of its beam in a regular scan.
_REGULAR_RAD = np.radians(0.1)


class CsvScans:
    """Scans of a file scans.csv: lines `# name = value`, then rows `stamp_ns, range_0, range_1, ...`.

    Raises:
        UserError: invalid content; the message contains file and line.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lidar: dict[str, float] = {}
        self.rows: list[tuple[int, str]] = []  # stamp and the text of the ranges, parsed when needed
        try:
            lines = path.read_text().splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise UserError(f"{path}: cannot be read: {reason(error)}") from error
        for number, line in enumerate(lines, start=1):
            where = f"{path}, line {number}"
            if line.lstrip().startswith("#"):
                self._take_setting(line.lstrip("# \t"), where)
            elif line.strip():
                stamp, _, ranges = line.partition(",")
                if not stamp.strip().isdecimal() or int(stamp) >= 2**63:
                    raise UserError(f"{where}: {stamp.strip()!r} is not a stamp in nanoseconds")
                self.rows.append((int(stamp), ranges))
        missing = [name for name in _REQUIRED if name not in self._lidar]
        if missing:
            raise UserError(
                f"{path}: needs comment lines like `# {missing[0]} = ...`; missing: {', '.join(missing)}"
            )
        self.rows.sort(key=lambda row: row[0])

    def _take_setting(self, text: str, where: str) -> None:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not equals:
            return
        if name not in _REQUIRED + _OPTIONAL:
            raise UserError(
                f"{where}: unknown setting {name!r}; there are {', '.join(_REQUIRED + _OPTIONAL)}"
            )
        try:
            self._lidar[name] = float(value)
        except ValueError as error:
            raise UserError(f"{where}: {name} = {value!r} is not a number") from error

    def fields(self, ranges: str) -> dict[str, Any]:
        """Return the fields of a scan message from `ranges`, the text of a row after the stamp.

        Raises:
            ValueError: a range is not a number.
        """
        values = [float(word) for word in ranges.split(",")] if ranges.strip() else []
        defaults = dict.fromkeys(_OPTIONAL, 0.0)
        return {**defaults, **self._lidar, "ranges_m": np.array(values, dtype=np.float32)}


def xy_from_pcd(data: bytes, name: str) -> np.ndarray:
    """Return the x and y coordinates (m), float64 [N, 2], of a PCD file (ASCII or binary, uncompressed).

    Raises:
        ValueError: not such a file; the message contains the reason.
    """
    header: dict[str, list[str]] = {}
    position = 0
    while "DATA" not in header:
        end = data.find(b"\n", position)
        if end < 0:
            raise ValueError(f"{name} is not a PCD file: no DATA line")
        words = data[position:end].decode("ascii", "replace").split()
        if words:
            header[words[0]] = words[1:]
        position = end + 1
    fields = header.get("FIELDS", [])
    if "x" not in fields or "y" not in fields:
        raise ValueError(f"{name} has the fields {fields}, x and y are needed")
    columns = [fields.index("x"), fields.index("y")]
    if header["DATA"] == ["ascii"]:
        rows = [line.split() for line in data[position:].splitlines() if line.strip()]
        if any(len(row) < len(fields) for row in rows):
            raise ValueError(f"{name} has a row with less than {len(fields)} values")
        return np.array([[float(row[c]) for c in columns] for row in rows]).reshape(-1, 2)
    if header["DATA"] == ["binary"]:
        return _binary_xy(header, data[position:], name)
    raise ValueError(f"{name} has DATA {' '.join(header['DATA'])}; ascii and binary can be read")


def _binary_xy(header: dict[str, list[str]], data: bytes, name: str) -> np.ndarray:
    try:
        kinds = [{"F": "f", "I": "i", "U": "u"}[t] + s for t, s in zip(header["TYPE"], header["SIZE"])]
        counts = [int(c) for c in header.get("COUNT", ["1"] * len(kinds))]
        names = [f"{field}.{i}" for i, field in enumerate(header["FIELDS"])]
        record = np.dtype(list(zip(names, kinds, [(c,) for c in counts], strict=True)))
        points = np.frombuffer(data, record, int(header["POINTS"][0]))
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise ValueError(f"{name}: header and data do not fit: {error}") from error
    x, y = (names[header["FIELDS"].index(axis)] for axis in "xy")
    return np.stack([points[x][:, 0], points[y][:, 0]], axis=1).astype(np.float64)


def scan_from_points(
    points_m: np.ndarray, range_min_m: float, range_max_m: float, scan_time_s: float
) -> dict[str, Any]:
    """Return the fields of a scan message from the points [N, 2] (m, lidar frame) of one revolution.

    The points are in the order of measurement. A point at the origin is a beam without return. If the
    directions have a constant step, as with most drivers, the scan has the same beams in the same order.
    Otherwise each point is assigned to the nearest beam of a grid four times finer than the median step, and
    beams without a point are NaN (not measured).
    """
    ranges = np.hypot(points_m[:, 0], points_m[:, 1])
    valid = np.isfinite(ranges) & (ranges > 0.0)
    if valid.sum() < 2:
        raise ValueError(f"{int(valid.sum())} valid points are not a scan; at least 2 are needed")
    index = np.flatnonzero(valid)
    angles = np.unwrap(np.arctan2(points_m[index, 1], points_m[index, 0]))
    step = float(np.median(np.diff(angles) / np.diff(index)))
    # A line through the first direction with that step, then least squares on the residuals.
    remainder = np.angle(np.exp(1j * (angles - angles[0] - step * (index - index[0]))))
    slope, offset = np.polyfit(index - index[0], remainder, 1)
    error = np.abs(remainder - offset - slope * (index - index[0]))
    if step != 0.0 and error.max() <= _REGULAR_RAD:
        increment = step + float(slope)
        start = float(angles[0] + offset - increment * index[0])
        filled = np.where(valid, ranges, np.inf)
        time_increment_s = scan_time_s / len(filled)
    else:
        start, increment, filled = _on_grid(angles, ranges[index])
        time_increment_s = 0.0  # the order in time is unknown
    return {
        "angle_min_rad": float(np.angle(np.exp(1j * start))),
        "angle_increment_rad": increment,
        "time_increment_s": time_increment_s,
        "scan_time_s": scan_time_s,
        "range_min_m": range_min_m,
        "range_max_m": range_max_m,
        "ranges_m": filled.astype(np.float32),
    }


def _on_grid(angles: np.ndarray, ranges: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Return start angle, angle increment and ranges of unordered directions, on a regular grid.

    If several points are assigned to one beam, the nearest point is used.
    """
    around = np.sort(np.mod(angles, 2.0 * np.pi))
    steps = np.diff(around)
    typical = float(np.median(steps[steps > 1e-6])) if np.any(steps > 1e-6) else 2.0 * np.pi
    count = int(np.clip(4 * round(2.0 * np.pi / typical), 4, 65536))
    increment = 2.0 * np.pi / count
    beam = np.round((np.mod(angles + np.pi, 2.0 * np.pi)) / increment).astype(int) % count
    filled = np.full(count, np.inf)
    np.minimum.at(filled, beam, ranges)
    filled[np.isinf(filled)] = np.nan
    return -np.pi, increment, filled
