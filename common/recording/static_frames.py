"""The tree of fixed transforms of a robot: what is bolted to what, from /tf_static or constant /tf."""

from __future__ import annotations

import numpy as np

from beamsplat.common.geometry.transforms import inverse

# Best first. base_footprint lies on the floor by REP 120, as our body does.
BODY_NAMES = (
    "base_footprint",
    "body",
    "base_link",
    "base",
    "chassis",
    "base_frame",
    "robot_base",
    "chassis_link",
)
_SAME = 1e-6  # metres and rotation-matrix entries: below that a repeated transform has not moved


class StaticFrames:
    """Fixed transforms between named frames; a transform seen with two values is not fixed."""

    def __init__(self) -> None:
        self._parent: dict[str, tuple[str, np.ndarray]] = {}  # child -> (parent, T_parent_child)
        self.moving: set[tuple[str, str]] = set()  # (parent, child) that changed

    def add(self, parent: str, child: str, T_parent_child: np.ndarray, *, replace: bool = False) -> None:
        """Takes one transform [4, 4]. With `replace` a newer value wins (a latched publisher corrected
        itself); without, a change marks the pair as moving."""
        parent, child = clean(parent), clean(child)
        if not child or parent == child or (parent, child) in self.moving:
            return
        known = self._parent.get(child)
        if known is None or replace:
            self._parent[child] = (parent, T_parent_child)
        elif known[0] == parent and not np.allclose(known[1], T_parent_child, atol=_SAME, rtol=0.0):
            self.moving.add((parent, child))
            del self._parent[child]

    @property
    def names(self) -> set[str]:
        """All frames with a fixed place relative to another."""
        return set(self._parent) | {parent for parent, _ in self._parent.values()}

    def find(self, a: str, b: str) -> np.ndarray | None:
        """`T_a_b` [4, 4] along the tree, or None if no chain of fixed transforms joins them."""
        a, b = clean(a), clean(b)
        up_a, up_b = self._chain(a), self._chain(b)
        for ancestor, T_ancestor_a in up_a.items():
            if ancestor in up_b:
                return inverse(T_ancestor_a) @ up_b[ancestor]
        return None

    def path(self, a: str, b: str) -> list[str]:
        """Frames on the way from a to b, for telling people; [] if there is none."""
        up_a, up_b = list(self._chain(clean(a))), list(self._chain(clean(b)))
        common = next((frame for frame in up_a if frame in up_b), None)
        if common is None:
            return []
        return up_a[: up_a.index(common) + 1] + up_b[: up_b.index(common)][::-1]

    def body_frame(self, sensors: list[str], odometry_child: str) -> str | None:
        """The robot's own frame: a customary name joined to a sensor; else the child of the odometry."""
        known = self.names | {clean(odometry_child)} - {""}
        for name in BODY_NAMES:
            for frame in sorted(known):
                joined = any(self.find(frame, sensor) is not None for sensor in sensors)
                if frame.split("/")[-1] == name and (joined or not sensors):
                    return frame
        return clean(odometry_child) or None

    def _chain(self, frame: str) -> dict[str, np.ndarray]:
        """Frame and its ancestors, each with `T_ancestor_frame`."""
        chain = {frame: np.eye(4)}
        T = np.eye(4)
        while frame in self._parent:
            frame, T_parent_child = self._parent[frame]
            if frame in chain:  # a loop in a broken tree
                break
            T = T_parent_child @ T
            chain[frame] = T
        return chain


def clean(frame: str) -> str:
    """Frame name without the leading slash of old ROS 1 drivers."""
    return frame.strip().lstrip("/")
