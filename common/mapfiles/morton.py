"""Morton codes (Z-order): neighbours in space are near each other in a file, and compress well."""

from __future__ import annotations

import numpy as np

BITS = 21  # per axis


def morton_codes(cells: np.ndarray) -> np.ndarray:
    """Return the Morton codes int64 [N] of cells int [N, 3] in [0, 2**21).

    Bit 3 k of a code is bit k of x, bit 3 k + 1 that of y, bit 3 k + 2 that of z.
    """
    x, y, z = (_spread(column.astype(np.uint64)) for column in cells.T)
    return (x | (y << np.uint64(1)) | (z << np.uint64(2))).astype(np.int64)


def morton_order(points_m: np.ndarray) -> np.ndarray:
    """Return the order int64 [N] of points [N, 3] along a Morton curve through their bounding cube."""
    if len(points_m) == 0:
        return np.zeros(0, np.int64)
    low = points_m.min(axis=0).astype(np.float64)
    extent = max(float((points_m.max(axis=0) - low).max()), 1e-9)
    cells = np.minimum((points_m - low) / extent * 2**BITS, 2**BITS - 1).astype(np.int64)
    return np.argsort(morton_codes(cells), kind="stable")


def _spread(value: np.ndarray) -> np.ndarray:
    """Insert two zero bits after each of the lowest 21 bits of uint64 [N]."""
    value = value & np.uint64(0x1FFFFF)
    for shift, mask in (
        (32, 0x001F00000000FFFF), (16, 0x001F0000FF0000FF), (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249),
    ):  # fmt: skip
        value = (value | (value << np.uint64(shift))) & np.uint64(mask)
    return value
