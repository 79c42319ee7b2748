"""Record of every scan: its stamp, the node that it is attached to, and its pose as published."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from beamsplat.services.localization.lidar2d import se2


class TrajectoryRecord:
    """Stamp, node and poses of every scan in growing arrays: 64 bytes per scan, 18 MB in 8 h at 10 Hz.

    Rows are never changed, so that another thread may read those that existed when it started.
    """

    ROW_BYTES = 64

    def __init__(self) -> None:
        self.count = 0
        self._stamps = np.zeros(1024, dtype=np.int64)
        self._nodes = np.zeros(1024, dtype=np.int64)
        self._poses = np.zeros((1024, 6))

    def add(self, stamp_ns: int, node: int, pose_node_body: np.ndarray, pose_map_body: np.ndarray) -> None:
        """Append a scan: its pose [3] relative to the node `node`, and its published pose [3] in the map."""
        if self.count == len(self._stamps):
            for name in ("_stamps", "_nodes", "_poses"):
                old = getattr(self, name)
                setattr(self, name, np.concatenate([old, np.zeros_like(old)]))
        self._stamps[self.count], self._nodes[self.count] = stamp_ns, node
        self._poses[self.count, :3], self._poses[self.count, 3:] = pose_node_body, pose_map_body
        self.count += 1

    @property
    def stamps_ns(self) -> np.ndarray:
        """Return the stamps int64 [N]."""
        return self._stamps[: self.count].copy()

    @property
    def nodes(self) -> np.ndarray:
        """Return the node ids int64 [N]."""
        return self._nodes[: self.count].copy()

    @property
    def online(self) -> np.ndarray:
        """Return pose_map_body as published, float64 [N, 3]."""
        return self._poses[: self.count, 3:].copy()

    def optimised(self, pose_map_node: dict[int, np.ndarray]) -> np.ndarray:
        """Return pose_map_body float64 [N, 3] for the current poses of the nodes."""
        unique, inverse = np.unique(self.nodes, return_inverse=True)
        base = np.array([pose_map_node[int(n)] for n in unique]).reshape(-1, 3)
        return se2.compose_many(base[inverse], self._poses[: self.count, :3])

    def arrays(self) -> dict[str, np.ndarray]:
        """Return copies of the arrays for saving."""
        return self.rows(0, self.count)

    def rows(self, first: int, end: int) -> dict[str, np.ndarray]:
        """Return copies of the rows `first` to before `end`."""
        return {
            "extra_stamps": self._stamps[first:end].copy(),
            "extra_nodes": self._nodes[first:end].copy(),
            "extra_poses": self._poses[first:end].copy(),
        }

    @staticmethod
    def joined(parts: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
        """Return the rows of several results of `rows`, one after the other."""
        empty = TrajectoryRecord().arrays()
        return {key: np.concatenate([array, *(part[key] for part in parts)]) for key, array in empty.items()}

    @staticmethod
    def of(arrays: dict[str, np.ndarray]) -> TrajectoryRecord:
        """Create a record from the result of `arrays()`."""
        record = TrajectoryRecord()
        if len(arrays["extra_stamps"]):
            record._stamps, record._nodes = arrays["extra_stamps"].copy(), arrays["extra_nodes"].copy()
            record._poses = arrays["extra_poses"].copy()
            record.count = len(record._stamps)
        return record
