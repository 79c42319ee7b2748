"""Depth maps of past keyframes, transformed (warped) into the view of another image."""

from __future__ import annotations

import copy
from collections import deque
from dataclasses import dataclass

import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.common.geometry.transforms import inverse


@dataclass(frozen=True)
class WarpedDepth:
    """Depth of past keyframes, warped into the pixels of another view (optical z of that view)."""

    depth_m: np.ndarray  # float32 [h, w], NaN = seen by no keyframe
    votes: np.ndarray  # int64 [h, w]: keyframes that agree on it


class KeyframeDepths:
    """Buffer of the newest `most` keyframe depth maps of one camera, at the working size."""

    def __init__(self, K: np.ndarray, shape: tuple[int, int], most: int) -> None:
        self._K = np.asarray(K, dtype=np.float32)  # [4] fx, fy, cx, cy
        self._shape = shape
        self._ring: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=most)

    def __len__(self) -> int:
        return len(self._ring)

    def copy(self) -> KeyframeDepths:
        """Return a buffer with the same depth maps, which changes independently."""
        other = copy.copy(self)
        other._ring = self._ring.copy()
        return other

    def add(self, T_map_camera: np.ndarray, depth_m: np.ndarray) -> None:
        """Store the depth map (optical z, m, float32 [h, w]) of a keyframe; NaN pixels are not warped."""
        self._ring.append((T_map_camera, np.ascontiguousarray(depth_m, dtype=np.float32)))

    def warp_into(self, T_map_camera: np.ndarray, agreement: float = 0.06) -> WarpedDepth:
        """Return the depth of all stored keyframes, warped into the camera view at `T_map_camera` [4, 4].

        Per pixel: the median of the warped depths, and the number of keyframes within `agreement` (log depth)
        of it.
        """
        warped = np.full((len(self._ring), *self._shape), np.nan, dtype=np.float32)
        T_camera_map = inverse(T_map_camera)
        for k, (T_map_then, depth) in enumerate(self._ring):
            T = (T_camera_map @ T_map_then).astype(np.float32)
            warp_depth(depth, T[:3, :3].copy(), T[:3, 3].copy(), self._K, warped[k])
        depth = np.full(self._shape, np.nan, dtype=np.float32)
        votes = np.zeros(self._shape, dtype=np.int64)
        median_vote(warped, agreement, depth, votes)
        return WarpedDepth(depth, votes)


@kernel
def warp_depth(z: np.ndarray, R: np.ndarray, t: np.ndarray, K: np.ndarray, out: np.ndarray) -> None:
    """Warp a depth map float32 [h, w] from one view into another, with a z-buffer; write `out` [h, w].

    `R` [3, 3], `t` [3] transform points of the first camera frame to the second. A pixel covers an area that
    grows as the surface is nearer in the second view, plus 0.3 px on each side to close gaps.
    """
    h, w = z.shape
    fx, fy, cx, cy = K[0], K[1], K[2], K[3]
    one, half, seam, least = np.float32(1.0), np.float32(0.5), np.float32(0.3), np.float32(0.1)
    right, bottom = np.float32(w - 1), np.float32(h - 1)
    for v in range(h):
        ry = (np.float32(v) - cy) / fy
        bx, by, bz = R[0, 1] * ry + R[0, 2], R[1, 1] * ry + R[1, 2], R[2, 1] * ry + R[2, 2]
        for u in range(w):
            d = z[v, u]
            if not d > 0.0:
                continue
            rx = (np.float32(u) - cx) / fx
            Z = (R[2, 0] * rx + bz) * d + t[2]
            if least > Z:
                continue
            inverse_z = one / Z
            a = fx * ((R[0, 0] * rx + bx) * d + t[0]) * inverse_z + cx
            b = fy * ((R[1, 0] * rx + by) * d + t[1]) * inverse_z + cy
            reach = half * d * inverse_z + seam
            if not (-reach <= a <= right + reach and -reach <= b <= bottom + reach):
                continue
            first, stop = max(int(np.ceil(a - reach)), 0), min(int(np.floor(a + reach)), w - 1) + 1
            for i in range(max(int(np.ceil(b - reach)), 0), min(int(np.floor(b + reach)), h - 1) + 1):
                for j in range(first, stop):
                    if not out[i, j] <= Z:  # also where it is NaN
                        out[i, j] = Z


@kernel
def median_vote(warped: np.ndarray, agreement: float, depth: np.ndarray, votes: np.ndarray) -> None:
    """Write, per pixel, the median of n depths and how many are within `agreement` (log) of the median.

    `warped` float32 [n, h, w]; NaN is ignored. Writes `depth` and `votes` [h, w].
    """
    n, h, w = warped.shape
    values = np.empty(n, np.float64)
    low, high = np.exp(-agreement), np.exp(agreement)
    for v in range(h):
        for u in range(w):
            count = 0
            for k in range(n):
                z = warped[k, v, u]
                if z > 0.0:
                    i = count
                    while i > 0 and values[i - 1] > z:
                        values[i] = values[i - 1]
                        i -= 1
                    values[i] = z
                    count += 1
            if count == 0:
                continue
            middle = values[(count - 1) // 2]
            depth[v, u] = middle
            for k in range(count):
                if low * middle <= values[k] <= high * middle:
                    votes[v, u] += 1
