"""The tree of static transforms between a robot's frames, from /tf_static or constant transforms on /tf."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from beamsplat.common.geometry.transforms import inverse

# In order of preference. base_footprint is on the floor by REP 120, like our body frame.
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
MAX_FRAMES = 2000  # in one tree; a humanoid robot has several hundred
_TOLERANCE = 1e-6  # metres and rotation matrix entries: a repeated transform within this has not changed


class StaticFrames:
    """Static transforms between named frames; a transform received with different values is not static."""

    def __init__(self) -> None:
        self._parent: dict[str, tuple[str, np.ndarray]] = {}  # child -> (parent, T_parent_child)
        self.moving: set[tuple[str, str]] = set()  # (parent, child) whose transform changed
        self.replaced: dict[
            tuple[str, str], tuple[np.ndarray, np.ndarray]
        ] = {}  # first and last T_parent_child
        self.reparented: dict[
            str, tuple[str, str]
        ] = {}  # child -> first and last parent of latched transforms
        self.ignored = 0  # transforms to further frames, when there are `MAX_FRAMES`

    def add(self, parent: str, child: str, T_parent_child: np.ndarray, *, replace: bool = False) -> None:
        """Add one received transform [4, 4].

        If the pair of frames already has a transform with another value: with `replace`, store the new value
        (a latched publisher has corrected it); otherwise mark the pair as moving and remove its transform.
        A new frame beyond `MAX_FRAMES` is ignored and counted.
        """
        parent, child = normalize_frame(parent), normalize_frame(child)
        if not child or parent == child or (parent, child) in self.moving:
            return
        known = self._parent.get(child)
        if known is None and len(self._parent) + len(self.moving) >= MAX_FRAMES:
            self.ignored += 1
        elif known is None or replace:
            if known is not None:
                self._note_change(child, known, parent, T_parent_child)
            self._parent[child] = (parent, T_parent_child)
        elif known[0] == parent and not np.allclose(known[1], T_parent_child, atol=_TOLERANCE, rtol=0.0):
            self.moving.add((parent, child))
            del self._parent[child]

    def _note_change(
        self, child: str, known: tuple[str, np.ndarray], parent: str, T_parent_child: np.ndarray
    ) -> None:
        """Remember that a latched transform was published again with another value or parent."""
        if known[0] != parent:
            self.reparented.setdefault(child, (known[0], parent))
        elif not np.allclose(known[1], T_parent_child, atol=_TOLERANCE, rtol=0.0):
            first = self.replaced.get((parent, child), (known[1], known[1]))[0]
            self.replaced[parent, child] = (first, T_parent_child)

    @classmethod
    def merged(cls, trees: list[StaticFrames]) -> StaticFrames:
        """Return the transforms of several trees in one; of the same child, that of the last tree holds."""
        if len(trees) == 1:
            return trees[0]
        found = cls()
        for tree in trees:
            found._parent |= tree._parent
            found.moving |= tree.moving
            found.replaced |= tree.replaced
            found.reparented |= tree.reparented
            found.ignored += tree.ignored
        for parent, child in found.moving:
            if found._parent.get(child, ("",))[0] == parent:
                del found._parent[child]
        return found

    def moving_between(self, a: str, b: str) -> list[tuple[str, str]]:
        """Return the moving pairs (parent, child) on the path between the frames a and b."""
        parents = {child: parent for child, (parent, _) in self._parent.items()}
        parents |= {child: parent for parent, child in self.moving}

        def up(frame: str) -> list[str]:
            chain = [frame]
            while frame in parents and parents[frame] not in chain:
                frame = parents[frame]
                chain.append(frame)
            return chain

        up_a, up_b = up(normalize_frame(a)), up(normalize_frame(b))
        common = next((frame for frame in up_a if frame in up_b), None)
        if common is None:
            return []
        path = up_a[: up_a.index(common)] + up_b[: up_b.index(common)]
        return [(parents[child], child) for child in path if (parents[child], child) in self.moving]

    def changes_between(self, a: str, b: str) -> list[str]:
        """Return sentences on latched transforms between a and b that were published with two values."""
        found = []
        path = self.path(a, b)
        for parent, child in pairwise(path):
            for pair in ((parent, child), (child, parent)):
                if pair in self.replaced:
                    first, last = self.replaced[pair]
                    found.append(
                        f"the static transform {pair[0]} -> {pair[1]} was published with different values, "
                        f"{_position(first)} and then {_position(last)}: the last is used; two robots "
                        "may have the "
                        "same names of frames"
                    )
        for frame in path:
            if frame in self.reparented:
                first_parent, last_parent = self.reparented[frame]
                found.append(
                    f"the frame {frame} has two static parents, {first_parent} and {last_parent}: the "
                    "last is used; "
                    "two robots may have the same names of frames"
                )
        return found

    def pairs_between(self, a: str, b: str) -> list[tuple[str, str]]:
        """Return the pairs (parent, child) on the path between the frames a and b."""
        path = self.path(a, b)
        pairs = []
        for one, other in pairwise(path):
            pairs.append((one, other) if self._parent.get(other, ("",))[0] == one else (other, one))
        return pairs

    def value(self, parent: str, child: str) -> np.ndarray | None:
        """Return the static `T_parent_child` [4, 4] of neighbouring frames, or None."""
        known = self._parent.get(child)
        return known[1] if known is not None and known[0] == parent else None

    @property
    def names(self) -> set[str]:
        """All frames that have a static transform to another frame."""
        return set(self._parent) | {parent for parent, _ in self._parent.values()}

    def find(self, a: str, b: str) -> np.ndarray | None:
        """Return `T_a_b` [4, 4], or None if no chain of static transforms connects the frames a and b."""
        a, b = normalize_frame(a), normalize_frame(b)
        up_a, up_b = self._chain(a), self._chain(b)
        for ancestor, T_ancestor_a in up_a.items():
            if ancestor in up_b:
                return inverse(T_ancestor_a) @ up_b[ancestor]
        return None

    def path(self, a: str, b: str) -> list[str]:
        """Return the names of the frames on the path from frame `a` to frame `b`; [] if there is no path."""
        up_a, up_b = list(self._chain(normalize_frame(a))), list(self._chain(normalize_frame(b)))
        common = next((frame for frame in up_a if frame in up_b), None)
        if common is None:
            return []
        return up_a[: up_a.index(common) + 1] + up_b[: up_b.index(common)][::-1]

    def body_frame(self, sensors: list[str], odometry_child: str) -> str | None:
        """Return the name of the ROS frame to use as body.

        This is the first of `BODY_NAMES` that is connected to a sensor, else the child frame of the wheel
        odometry.

        Args:
            sensors: names of the sensors' frames.
            odometry_child: child frame of the wheel odometry, "" = unknown.
        """
        known = self.names | {normalize_frame(odometry_child)} - {""}
        for name in BODY_NAMES:
            for frame in sorted(known):
                if frame.split("/")[-1] != name:
                    continue
                if not sensors or any(self.find(frame, sensor) is not None for sensor in sensors):
                    return frame
        return normalize_frame(odometry_child) or None

    def _chain(self, frame: str) -> dict[str, np.ndarray]:
        """Return the frame and its ancestors, each with `T_ancestor_frame`."""
        chain = {frame: np.eye(4)}
        T = np.eye(4)
        while frame in self._parent:
            frame, T_parent_child = self._parent[frame]
            if frame in chain:  # a cycle in an invalid tree
                break
            T = T_parent_child @ T
            chain[frame] = T
        return chain


def _position(T: np.ndarray) -> str:
    """Return the translation and the yaw of a transform [4, 4] as text."""
    x, y, z = T[:3, 3]
    return f"({x:.3f}, {y:.3f}, {z:.3f}) m, yaw {np.degrees(np.arctan2(T[1, 0], T[0, 0])):.1f} deg"


def normalize_frame(frame: str) -> str:
    """Return a frame name without spaces at its ends and without the leading slash of old ROS 1 drivers."""
    return frame.strip().lstrip("/")
