"""The range data of a trajectory node in 8 bytes per return, as it is kept in memory and on disk.

A map has thousands of nodes, whose scans are needed again for loop closure, refinement and relocalization.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

import numpy as np

from beamsplat.services.localization.lidar2d.scan import PreparedScan, half_spacing_m

# Number of returns and of features, metres per unit of the coordinates, position of the lidar.
_HEAD = struct.Struct("<IHfdd")
# Coordinates in units of the scan, surface direction in units of pi / 65534, spacing in m.
_RETURN = np.dtype([("x", "<i2"), ("y", "<i2"), ("direction", "<i2"), ("spacing", "<f2")])
_UNITS = 32767  # of the largest coordinate of a scan: steps of 1 mm for a return at 30 m
_UNKNOWN_DIRECTION = -32768
_RAD_PER_UNIT = 0.5 * math.pi / _UNITS
_MAX_RETURNS = 65536  # the largest number of beams of a scan; feature indices have 16 bits


@dataclass(frozen=True, slots=True)
class NodeScan:
    """Range data of one node in the body frame.

    Quantisation moves a return by at most 1/65534 of the largest coordinate in the scan, per axis.
    """

    data: bytes

    @staticmethod
    def of(scan: PreparedScan, dynamic: np.ndarray) -> NodeScan:
        """Create the scan of a node from a prepared scan and the mask bool [M] of dynamic returns."""
        static = scan.match_index[~dynamic[scan.match_index]]
        return NodeScan.packed(
            scan.points_body, scan.tangents, scan.spacing_m, dynamic, static, scan.origin_body
        )

    @staticmethod
    def packed(
        points: np.ndarray,  # float [M, 2]
        tangents: np.ndarray,  # float [M, 2], unit direction of the surface, (0, 0) where unknown
        spacing_m: np.ndarray,  # float [M]
        dynamic: np.ndarray,  # bool [M], returns on dynamic objects
        feature_index: np.ndarray,  # int [K], the static returns used for matching
        origin: np.ndarray,  # float64 [2], the lidar in the body frame
    ) -> NodeScan:
        """Quantise a scan.

        Raises:
            ValueError: more than 65536 returns, or values that are not finite.
        """
        count = len(points)
        if count > _MAX_RETURNS:
            raise ValueError(f"a node with {count} returns, at most {_MAX_RETURNS} are possible")
        if not (np.isfinite(points).all() and np.isfinite(tangents).all() and np.isfinite(spacing_m).all()):
            raise ValueError("a node with returns that are not finite")
        # Rounded to float32 first, because this is the value with which the scan is read.
        scale = float(np.float32(max(float(np.abs(points).max(initial=0.0)), 1e-3) / _UNITS))
        returns = np.empty(count, dtype=_RETURN)
        returns["x"], returns["y"] = np.clip(np.rint(points / scale), -_UNITS, _UNITS).T
        angle = np.arctan2(tangents[:, 1], tangents[:, 0])
        angle -= math.pi * np.rint(angle / math.pi)  # a surface has the same direction both ways
        known = np.abs(tangents).max(axis=1, initial=0.0) > 0.0
        returns["direction"] = np.where(known, np.rint(angle / _RAD_PER_UNIT), _UNKNOWN_DIRECTION)
        returns["spacing"] = np.minimum(spacing_m, 1e3)
        head = _HEAD.pack(count, len(feature_index), scale, *np.asarray(origin, dtype=np.float64).tolist())
        features = np.asarray(feature_index).astype("<u2")
        return NodeScan(
            b"".join([head, returns.tobytes(), features.tobytes(), np.packbits(dynamic).tobytes()])
        )

    def __len__(self) -> int:
        return _HEAD.unpack_from(self.data)[0]

    def check(self) -> None:
        """Raise ValueError unless the data, which may come from a damaged file, is consistent."""
        if len(self.data) < _HEAD.size:
            raise ValueError("a node without range data")
        count, features, scale, x, y = _HEAD.unpack_from(self.data)
        size = _HEAD.size + count * _RETURN.itemsize + 2 * features + (count + 7) // 8
        if len(self.data) != size or not 0.0 < scale < 1e3 or not (math.isfinite(x) and math.isfinite(y)):
            raise ValueError("a node with inconsistent range data")
        if features and int(self._feature_index.max()) >= count:
            raise ValueError("a node whose features are not among its returns")

    @property
    def _returns(self) -> np.ndarray:
        return np.frombuffer(self.data, _RETURN, len(self), _HEAD.size)

    @property
    def _feature_index(self) -> np.ndarray:
        count, features, *_ = _HEAD.unpack_from(self.data)
        return np.frombuffer(self.data, "<u2", features, _HEAD.size + count * _RETURN.itemsize)

    @property
    def points(self) -> np.ndarray:
        """Return the returns in the body frame, float64 [M, 2]."""
        return self._points_of(self._returns)

    def _points_of(self, returns: np.ndarray) -> np.ndarray:
        return np.column_stack([returns["x"], returns["y"]]) * _HEAD.unpack_from(self.data)[2]

    @property
    def tangents(self) -> np.ndarray:
        """Return the unit directions of the surface, float64 [M, 2], (0, 0) where unknown."""
        return _tangents_of(self._returns)

    @property
    def spacing_m(self) -> np.ndarray:
        """Return the distances between neighbouring returns on the surface, float64 [M]."""
        return self._returns["spacing"].astype(np.float64)

    @property
    def dynamic(self) -> np.ndarray:
        """Return the mask of returns on dynamic objects, bool [M]."""
        bits = np.frombuffer(self.data, np.uint8)[len(self.data) - (len(self) + 7) // 8 :]
        return np.unpackbits(bits, count=len(self)).astype(bool)

    @property
    def features(self) -> np.ndarray:
        """Return the static returns used for matching, float64 [K, 5], see PreparedScan.features."""
        chosen = self._returns[self._feature_index]
        half = half_spacing_m(chosen["spacing"].astype(np.float64))
        return np.column_stack([self._points_of(chosen), _tangents_of(chosen), half])

    @property
    def origin(self) -> np.ndarray:
        """Return the position of the lidar in the body frame, float64 [2]."""
        return np.array(_HEAD.unpack_from(self.data)[3:])


def _tangents_of(returns: np.ndarray) -> np.ndarray:
    angle = returns["direction"] * _RAD_PER_UNIT
    known = returns["direction"] != _UNKNOWN_DIRECTION
    return np.column_stack([np.cos(angle), np.sin(angle)]) * known[:, None]
