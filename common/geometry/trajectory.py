"""Trajectories of stamped poses: interpolation, association of stamps, reading and writing TUM files.

A TUM file has one pose per line, `stamp_s tx ty tz qx qy qz qw`, and `#` comments. Stamps are converted from
and to decimal text without a float: today's Unix time in nanoseconds needs 61 bits, a float64 has 53.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from itertools import pairwise
from pathlib import Path

import numpy as np

from beamsplat.common.errors import UserError, reason
from beamsplat.common.geometry.transforms import (
    interpolate,
    make_transform,
    matrix_from_quat_xyzw,
    quat_xyzw_from_matrix,
)

_MAX_STAMP_NS = 2**63 - 1


@dataclass(frozen=True)
class Trajectory:
    """Poses `T_a_b` of frame b in frame a at strictly increasing stamps.

    Raises:
        ValueError: the lengths differ, stamps do not increase, or a matrix is not a rigid transform.
    """

    stamps_ns: np.ndarray  # int64 [N]
    T_a_b: np.ndarray  # float64 [N, 4, 4]

    def __post_init__(self) -> None:
        stamps = np.asarray(self.stamps_ns, dtype=np.int64).reshape(-1)
        T = np.asarray(self.T_a_b, dtype=np.float64).reshape(-1, 4, 4)
        if len(stamps) != len(T):
            raise ValueError(f"{len(stamps)} stamps for {len(T)} poses")
        backwards = np.flatnonzero(np.diff(stamps) <= 0)
        if len(backwards):
            i = int(backwards[0])
            raise ValueError(f"stamps must increase: {stamps[i + 1]} ns comes after {stamps[i]} ns")
        bent = np.flatnonzero(~_rigid(T))
        if len(bent):
            i = int(bent[0])
            raise ValueError(f"pose {i} at {stamps[i]} ns is not a rigid transform: {T[i].tolist()}")
        object.__setattr__(self, "stamps_ns", stamps)
        object.__setattr__(self, "T_a_b", T)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def at(
        self, stamp_ns: int, *, max_gap_ns: int | None = None, max_extrapolation_ns: int = 0
    ) -> np.ndarray | None:
        """Return `T_a_b` [4, 4] at a stamp, interpolated between its two neighbours (see `interpolate`).

        Up to `max_extrapolation_ns` outside the covered time, the first or last step is continued. Returns
        None beyond that, or if the two neighbours are more than `max_gap_ns` apart.
        """
        count = len(self)
        if count == 0:
            return None
        after = int(np.searchsorted(self.stamps_ns, stamp_ns))
        if after < count and self.stamps_ns[after] == stamp_ns:
            return self.T_a_b[after].copy()
        if after == 0 or after == count:
            outside_ns = self.stamps_ns[0] - stamp_ns if after == 0 else stamp_ns - self.stamps_ns[-1]
            if outside_ns > max_extrapolation_ns or count == 1:
                return None
            after = min(max(after, 1), count - 1)
        t0, t1 = int(self.stamps_ns[after - 1]), int(self.stamps_ns[after])
        if max_gap_ns is not None and t1 - t0 > max_gap_ns:
            return None
        return interpolate(self.T_a_b[after - 1], self.T_a_b[after], (int(stamp_ns) - t0) / (t1 - t0))

    def resampled(
        self, stamps_ns: Iterable[int], *, max_gap_ns: int | None = None, max_extrapolation_ns: int = 0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Interpolate the poses at many stamps, and omit stamps for which `at` returns None.

        Returns:
            Indices int64 [M] into `stamps_ns`, and `T_a_b` float64 [M, 4, 4].
        """
        indices, poses = [], []
        for i, stamp_ns in enumerate(stamps_ns):
            T = self.at(int(stamp_ns), max_gap_ns=max_gap_ns, max_extrapolation_ns=max_extrapolation_ns)
            if T is not None:
                indices.append(i)
                poses.append(T)
        return np.array(indices, dtype=np.int64), np.array(poses, dtype=np.float64).reshape(-1, 4, 4)


def _rigid(T: np.ndarray, tolerance: float = 1e-6) -> np.ndarray:
    """Return `transforms.is_rigid` of each of T [N, 4, 4] as bool [N], vectorised."""
    R = T[:, :3, :3]
    orthonormal = np.all(np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)) <= tolerance, axis=(1, 2))
    last_row = np.all(T[:, 3] == [0.0, 0.0, 0.0, 1.0], axis=1)
    finite = np.all(np.isfinite(T), axis=(1, 2))
    return finite & orthonormal & last_row & (np.linalg.det(np.where(np.isfinite(R), R, 0.0)) > 0.0)


def read_tum(path: Path) -> Trajectory:
    """Read the trajectory in a TUM file; its lines may be in any order.

    Raises:
        UserError: the file cannot be read, a line does not contain eight numbers, or a stamp occurs twice;
            the text contains file and line number.
    """
    try:
        text = Path(path).read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: cannot be read as a TUM trajectory: {reason(error)}") from error
    return parse_tum(text, str(path))


def parse_tum(text: str, where: str) -> Trajectory:
    """Parse the text of a TUM file (see `read_tum`); `where` is the name of its source, for error texts."""
    rows: list[tuple[int, np.ndarray, int]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        content = line.split("#", 1)[0].replace(",", " ").split()
        if content:
            rows.append((*_parse_line(content, f"{where}, line {number}"), number))
    rows.sort(key=lambda row: row[0])
    for before, after in pairwise(rows):
        if before[0] == after[0]:
            raise UserError(
                f"{where}: lines {before[2]} and {after[2]} have the same stamp {format_stamp_s(after[0])}; "
                "keep one of them"
            )
    return Trajectory(
        np.array([row[0] for row in rows], dtype=np.int64),
        np.array([row[1] for row in rows]).reshape(-1, 4, 4),
    )


def _parse_line(content: list[str], where: str) -> tuple[int, np.ndarray]:
    if len(content) != 8:
        raise UserError(f"{where}: expected 8 numbers (stamp_s tx ty tz qx qy qz qw), found {len(content)}")
    stamp_ns = parse_stamp_s(content[0], where)
    try:
        values = np.array([float(word) for word in content[1:]])
        if not np.all(np.isfinite(values)):
            raise ValueError("a value is not finite")
        return stamp_ns, make_transform(matrix_from_quat_xyzw(values[3:]), values[:3])
    except ValueError as error:
        raise UserError(f"{where}: not a pose: {error}") from error


def parse_stamp_s(word: str, where: str) -> int:
    """Convert seconds as decimal text to int64 nanoseconds, exact to the nanosecond.

    Raises:
        UserError: the text is not a number, negative, or beyond int64.
    """
    try:
        seconds = Decimal(word)
        in_range = seconds.is_finite() and 0 <= seconds <= Decimal(_MAX_STAMP_NS) / 10**9
    except InvalidOperation:
        in_range = False
    if not in_range:
        raise UserError(f"{where}: {word!r} is not a stamp in seconds")
    return min(int((seconds * 10**9).to_integral_value()), _MAX_STAMP_NS)


def format_stamp_s(stamp_ns: int) -> str:
    """Return nanoseconds as decimal text in seconds, with nine decimals."""
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"


def format_tum(trajectory: Trajectory, comment: str = "") -> str:
    """Return the text of a TUM file: positions to 1e-6 m, quaternions to 1e-9."""
    lines = [f"# {line}" for line in comment.splitlines()]
    lines.append("# stamp_s tx ty tz qx qy qz qw")
    for stamp_ns, T in zip(trajectory.stamps_ns, trajectory.T_a_b):
        position = " ".join(f"{value:.6f}" for value in T[:3, 3])
        quat = " ".join(f"{value:.9f}" for value in quat_xyzw_from_matrix(T[:3, :3]))
        lines.append(f"{format_stamp_s(int(stamp_ns))} {position} {quat}")
    return "\n".join(lines) + "\n"


def write_tum(path: Path, trajectory: Trajectory, comment: str = "") -> None:
    """Write a TUM file and rename it into place, so that a reader never sees an incomplete file."""
    path = Path(path)
    partial = path.with_name(path.name + ".partial")
    partial.write_text(format_tum(trajectory, comment))
    os.replace(partial, path)
