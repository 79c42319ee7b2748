"""Score the result of `beamsplat compare` against the true changes between two simulated drives."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from beamsplat.common.errors import UserError, reason
from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.metrics import interpolate_poses
from beamsplat.services.localization.lidar2d.slam import LidarSlam
from beamsplat.tools.evaluation.slam import planar_poses

# A detection belongs to a true place of its kind if it covers so much of the smaller of both rectangles. The
# true one is grown by the margin: the error of depth at the distances from which furniture is seen.
MIN_COVERED, MARGIN_M = 0.3, 0.15


@dataclass(frozen=True)
class ChangedPlace:
    """A place where something truly appeared or vanished: a box in the world frame."""

    kind: str  # "appeared" or "vanished"
    change: int  # number of the change; a moved object has two places
    name: str
    box_m: np.ndarray  # float64 [6], lower corner and upper corner

    def rectangle(self) -> np.ndarray:
        """Return the corners of the footprint, grown by MARGIN_M, float64 [4, 2]."""
        (x0, y0), (x1, y1) = self.box_m[:2] - MARGIN_M, self.box_m[3:5] + MARGIN_M
        return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


@dataclass(frozen=True)
class Detection:
    """An object of a comparison: its kind and its footprint in the world frame, float64 [4, 2]."""

    kind: str
    rectangle: np.ndarray

    @staticmethod
    def of(row: dict[str, Any], pose_world_map: np.ndarray) -> Detection:
        """Return the detection of an entry of `objects` in changes.json."""
        centre, half = np.array(row["centre_m"][:2]), np.array(row["extent_m"][:2]) / 2
        corners = centre + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        return Detection(row["kind"], se2.transform(pose_world_map, corners))


def places_of(changes: list[dict[str, Any]]) -> list[ChangedPlace]:
    """Return the true places of the `changes` that the simulator has written."""
    out = []
    for number, change in enumerate(changes):
        for kind, key in (("vanished", "before_m"), ("appeared", "after_m")):
            if change[key] is not None:
                out.append(
                    ChangedPlace(kind, number, change["name"], np.array(change[key], dtype=np.float64))
                )
    return out


def score(places: list[ChangedPlace], detections: list[Detection]) -> dict[str, Any]:
    """Return how many true changes were found, and how many detections are false.

    A change is found if all of its places are: a moved object has to vanish here and appear there. It is
    found partly if one of two places is. A detection is false if it is at no true place of its kind; several
    detections at one place are not false.
    """
    at = [[_belongs(d, place) for place in places] for d in detections]
    found = {k for k in range(len(places)) if any(row[k] for row in at)}
    numbers = sorted({place.change for place in places})
    of = {n: [k in found for k, place in enumerate(places) if place.change == n] for n in numbers}
    errors = [_error_m(detections, at, k, places[k]) for k in sorted(found)]
    return {
        "changes": len(numbers),
        "found": sum(all(v) for v in of.values()),
        "found_partly": sum(any(v) and not all(v) for v in of.values()),
        "places": len(places),
        "places_found": len(found),
        "detections": len(detections),
        "false": sum(not any(row) for row in at),
        "false_numbers": [k + 1 for k, row in enumerate(at) if not any(row)],
        "centre_error_p50_m": float(np.median(errors)) if errors else None,
        "missed": [f"{p.kind} {p.name}" for k, p in enumerate(places) if k not in found],
    }


def _belongs(detection: Detection, place: ChangedPlace) -> bool:
    if detection.kind != place.kind:
        return False
    mine, its = detection.rectangle.astype(np.float32), place.rectangle().astype(np.float32)
    shared, _ = cv2.intersectConvexConvex(mine, its)
    smaller = min(cv2.contourArea(mine), cv2.contourArea(its))
    return shared >= MIN_COVERED * max(smaller, 1e-6)


def _error_m(detections: list[Detection], at: list[list[bool]], k: int, place: ChangedPlace) -> float:
    """Return the distance between the true centre and the middle of all detections of a place."""
    corners = np.concatenate([d.rectangle for d, row in zip(detections, at) if row[k]])
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    return float(np.linalg.norm(middle - (place.box_m[:2] + place.box_m[3:5]) / 2))


def pose_world_map(slam: LidarSlam, true_ns: np.ndarray, pose_world_body: np.ndarray) -> np.ndarray | None:
    """Return the pose float64 [3] of a lidar map in the world that fits its trajectory to the true one.

    Args:
        true_ns, pose_world_body: true trajectory, int64 [N] and float64 [N, 3].

    Returns:
        None if the trajectories have no time in common.
    """
    stamps_ns, pose_map_body, _ = slam.trajectory()
    inside = (stamps_ns >= true_ns[0]) & (stamps_ns <= true_ns[-1])
    if inside.sum() < 2:
        return None
    there = interpolate_poses(true_ns, pose_world_body, stamps_ns[inside])[:, :2]
    here = pose_map_body[inside, :2]
    p, q = here - here.mean(axis=0), there - there.mean(axis=0)
    yaw = math.atan2(float((p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum()), float((p * q).sum()))
    turned = se2.transform(np.array([0.0, 0.0, yaw]), here.mean(axis=0)[None])[0]
    return np.array([*(there.mean(axis=0) - turned), yaw])


def score_files(changes: Path, slam: LidarSlam, truth: Path, true_changes: Path) -> dict[str, Any]:
    """Return `score` of a result file.

    Args:
        changes: changes.json of `beamsplat compare`.
        slam: lidar map of the first session.
        truth: groundtruth.txt of the first drive.
        true_changes: changes.json of the second simulated drive.

    Raises:
        UserError: a file cannot be read, or is not what it should be; the text names file and field.
    """
    pose = pose_world_map(slam, *planar_poses(truth))
    if pose is None:
        raise UserError(f"{truth}: has no poses of the time of the first session; give those of its drive")
    found = [Detection.of(row, pose) for row in _table(changes, "objects")]
    return score(places_of(_table(true_changes, "changes")), found)


def _table(path: Path, field: str) -> list[dict[str, Any]]:
    try:
        return list(json.loads(path.read_text())[field])
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read as JSON: {reason(error)}") from error
    except (KeyError, TypeError) as error:
        writer = "`beamsplat compare`" if field == "objects" else "`beamsplat simulate --moved N`"
        raise UserError(f"{path}: has no field '{field}'; give the file that {writer} has written") from error
