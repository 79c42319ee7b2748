"""Diagnosis of a robot's calibration at the start: which possible fault explains images and poses best.

Before an offset is named, the model itself is tested: every hypothesis is fitted to the same corners
(hypotheses.py), and one other than "a small error of clock or mount" is named only if it explains them
clearly better. What images and poses cannot tell apart in planar motion is decided by other evidence: which
way up the images are, by the floor; whether the lidar or the image is mirrored, by the wheel odometry.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beamsplat.common.geometry.transforms import inverse, so3_exp
from beamsplat.services.fusion.calibration.hypotheses import CornerProblem, Fit, Hypothesis, PoseAt

_CLEARLY = 0.85  # a gross fault is named if its cost is below this share of that of a small error
_LEAST_GAIN = 0.006  # of the cost, mean of log(1 + r^2): the cost of correct corners varies by about 0.002
_EXPLAINED_PX = 2.0  # a corner farther from every prediction is on something that moves, or a wrong track
_PLAUSIBLE = 5  # hypotheses with the lowest cost of all corners, by which the others are judged
_LEAST_CORNERS = 100
_TURN_SIGMA_RAD = 0.1  # of the turn of the mount that a gross hypothesis needs besides: small ones win
_TURN_WEIGHT = 0.005
_FLOOR_WEIGHT = 0.3
# How unusual a fault is, in units of the cost: decides only between hypotheses that explain the same.
_UNUSUAL = {"images upside down": 0.002, "images mirrored": 0.004, "images flipped": 0.004}
_CLOSE_COST = 0.02  # hypotheses within this difference are not told apart by the corners
_LEAST_ODOMETRY = 8  # motions of more than 0.15 m or 0.1 rad that the comparison with wheels needs
_LIDAR_TURN_RAD = np.radians(5.0)  # a smaller difference to the direction of the wheels is not named

_TURN = ("roll", "pitch", "yaw")
_FLIP = np.diag([1.0, -1.0, 1.0, 1.0])
_HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
_CLOCKS_S = tuple(float(c) for c in np.arange(-0.32, 0.33, 0.08))
_SIZES = ((0.0,), (0.35,), (-0.35,), (0.7,), (-0.7,))
SMALL = ("ok", "clock", "mount", "clock and mount")
MIRRORED = ("images mirrored", "lidar mirrored", "images upside down")

HYPOTHESES = (
    Hypothesis("ok"),
    Hypothesis("clock", ("clock",), tuple((c,) for c in _CLOCKS_S)),
    Hypothesis("mount", _TURN),
    Hypothesis("clock and mount", ("clock", *_TURN), tuple((c, 0.0, 0.0, 0.0) for c in _CLOCKS_S)),
    Hypothesis("principal point", ("shift_x", "shift_y")),
    Hypothesis("K", ("log_focal",), _SIZES),
    Hypothesis("K of another size", ("size",), _SIZES),
    Hypothesis("distortion", ("k1", "k2")),
    Hypothesis("images upside down", _TURN, image=np.diag([-1.0, -1.0])),
    Hypothesis("images mirrored", _TURN, image=np.diag([-1.0, 1.0])),
    Hypothesis("images flipped", _TURN, image=np.diag([1.0, -1.0])),
    Hypothesis("images turned left", _TURN, image=np.array([[0.0, 1.0], [-1.0, 0.0]])),
    Hypothesis("images turned right", _TURN, image=np.array([[0.0, -1.0], [1.0, 0.0]])),
    Hypothesis("optical frame", _TURN, optical=True),
    Hypothesis("lidar mirrored", _TURN, lidar=_FLIP),
    Hypothesis("lidar turned", _TURN, lidar=_HALF_TURN),
    Hypothesis("lidar mirrored and turned", _TURN, lidar=_HALF_TURN @ _FLIP),
)


@dataclass(frozen=True)
class Evidence:
    """The fits of all hypotheses and what was found beside the corners.

    `cause`: the hypothesis that explains the data; one of `SMALL` if no gross fault does; "wheels" if they
    contradict both lidar and camera. `against`: cost of the best small error. `clock_first`: of two small
    errors that of the clock explains more.
    """

    cause: str
    best: Fit
    against: float
    explained_share: float  # of the corners that at least one hypothesis explains; the others are left out
    clock_first: bool = True
    alternatives: tuple[str, ...] = ()  # causes that the data do not tell from `cause`
    lidar_turn_rad: float = 0.0  # to add to the lidar's yaw, by the wheels


@dataclass(frozen=True)
class WheelEvidence:
    """Comparison of the motions of the poses with those of the wheels."""

    mounting: str  # "ok", "lidar mirrored", "lidar turned", "lidar mirrored and turned"
    turn_rad: float  # direction of the wheels' motion minus that of the poses, after `mounting`


def weigh(problem: CornerProblem, wheels: WheelEvidence | None) -> Evidence:
    """Fit all hypotheses and return the cause with the best evidence.

    `wheels`: None = no wheel odometry, or too little motion.
    """
    hypotheses: tuple[Hypothesis, ...] = HYPOTHESES
    if wheels is not None:  # the wheels decide about the lidar
        hypotheses = tuple(
            h for h in hypotheses if not h.cause.startswith("lidar") or h.cause == wheels.mounting
        )
        if abs(wheels.turn_rad) > _LIDAR_TURN_RAD and wheels.mounting == "ok":
            turn = np.eye(4)
            turn[:3, :3] = so3_exp(np.array([0.0, 0.0, wheels.turn_rad]))
            hypotheses += (Hypothesis("lidar yaw", _TURN, lidar=turn),)
    first = sorted((problem.fit(h) for h in hypotheses), key=lambda fit: fit.cost)
    kept = problem.explained(first[:_PLAUSIBLE], _EXPLAINED_PX)
    explained_share = float(np.mean(kept)) if len(kept) else 0.0
    if kept.sum() >= _LEAST_CORNERS:
        problem.restrict(kept)
    fits = {h.cause: problem.fit(h) for h in hypotheses}
    scores = {cause: _score(problem, fit) for cause, fit in fits.items()}
    small = min((cause for cause in SMALL), key=lambda cause: scores[cause])
    gross = min((cause for cause in fits if cause not in SMALL), key=lambda cause: scores[cause])
    clear = scores[gross] < min(_CLEARLY * scores[small], scores[small] - _LEAST_GAIN)
    if wheels is not None and wheels.mounting != "ok":
        # The poses contradict the wheels: it is the lidar, unless the images agree with its poses.
        clear = True
        gross = wheels.mounting if scores[wheels.mounting] < scores[small] else "wheels"
        if gross == "wheels":
            return Evidence(gross, fits[small], fits[small].cost, explained_share)
    if not clear:
        clock_first = fits["clock"].cost < fits["mount"].cost
        return Evidence(small, fits[small], fits[small].cost, explained_share, clock_first)
    close = {c for c in fits if c not in (*SMALL, gross) and scores[c] < scores[gross] + _CLOSE_COST}
    told = MIRRORED if gross in MIRRORED and wheels is None else ()
    alternatives = tuple(c for c in told if c in close)
    turn_rad = wheels.turn_rad if wheels is not None and gross == "lidar yaw" else 0.0
    return Evidence(
        gross,
        fits[gross],
        fits[small].cost,
        explained_share,
        alternatives=alternatives,
        lidar_turn_rad=turn_rad,
    )


def _score(problem: CornerProblem, fit: Fit) -> float:
    """Return the cost of a fit with what else speaks against it: corners under the floor, a large turn."""
    below = problem.below_floor_share(fit)
    score = fit.cost + (_FLOOR_WEIGHT * below if np.isfinite(below) else 0.0)
    if fit.hypothesis.cause not in SMALL:
        turn = np.array([fit.values.get(name, 0.0) for name in _TURN])
        score += _UNUSUAL.get(fit.hypothesis.cause, 0.0)
        score += _TURN_WEIGHT * float(np.sum((turn / _TURN_SIGMA_RAD) ** 2))
    return score


def compare_with_wheels(
    stamps_ns: np.ndarray,  # int64 [N], of the poses
    T_map_body: np.ndarray,  # float64 [N, 4, 4]
    wheel_at: PoseAt,
    T_body_lidar: np.ndarray,
) -> WheelEvidence | None:
    """Compare the motion of poses from scans with that of the wheels, over 0.5 s each.

    Poses from a lidar that is mirrored or turned on its mount are consistent with its scans, but not with the
    wheels: the robot then seems to turn the other way, or to drive backwards.

    Returns:
        Which mounting of the lidar makes both agree; None with too few motions.
    """
    motions = []
    last = 0
    for k in range(1, len(stamps_ns)):
        if stamps_ns[k] - stamps_ns[last] < 500_000_000:
            continue
        a, b = wheel_at(int(stamps_ns[last])), wheel_at(int(stamps_ns[k]))
        if a is not None and b is not None:
            by_poses = inverse(T_map_body[last]) @ T_map_body[k]
            by_wheels = inverse(a) @ b
            if np.linalg.norm(by_wheels[:2, 3]) > 0.15 or abs(np.arctan2(*by_wheels[[1, 0], 0])) > 0.1:
                motions.append((by_poses, by_wheels))
        last = k
    if len(motions) < _LEAST_ODOMETRY:
        return None
    poses, wheels = (np.array(m) for m in zip(*motions))
    mountings = {
        "ok": np.eye(4), "lidar mirrored": _FLIP, "lidar turned": _HALF_TURN,
        "lidar mirrored and turned": _HALF_TURN @ _FLIP,
    }  # fmt: skip
    misfits, turns = {}, {}
    for name, change in mountings.items():
        X = T_body_lidar @ change @ inverse(T_body_lidar)
        moved = X @ poses @ np.linalg.inv(X)
        misfits[name] = _misfit(moved, wheels)
        turns[name] = _direction(moved, wheels)
    # Of the turned ones only those that no turn of the direction explains: "ok" with 180 degrees is "turned".
    best = min(misfits, key=lambda name: misfits[name])
    if best != "ok" and misfits[best] > 0.5 * misfits["ok"]:
        best = "ok"
    return WheelEvidence(best, turns[best])


def _misfit(moved: np.ndarray, wheels: np.ndarray) -> float:
    """Return the median difference of planar motions: metres, with 0.3 m for a radian."""
    way = np.linalg.norm(moved[:, :2, 3] - wheels[:, :2, 3], axis=1)
    turn = [np.arctan2(d[1, 0], d[0, 0]) for d in np.swapaxes(moved[:, :3, :3], 1, 2) @ wheels[:, :3, :3]]
    return float(np.median(way + 0.3 * np.abs(turn)))


def _direction(moved: np.ndarray, wheels: np.ndarray) -> float:
    """Return the median angle (rad) from the direction of the poses' motion to that of the wheels'."""
    far = np.linalg.norm(wheels[:, :2, 3], axis=1) > 0.1
    if far.sum() < _LEAST_ODOMETRY // 2:
        return 0.0
    a, b = moved[far, :2, 3], wheels[far, :2, 3]
    cross, dot = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], np.sum(a * b, axis=1)
    return float(np.median(np.arctan2(cross, dot)))


_TURNED = "the images are turned by 90 degrees: turn them in the driver, and calibrate after it"
_REMEDIES = {
    "images upside down": "the images are upside down: turn them by 180 degrees in the driver, or correct "
    "the roll of the camera's mount by 180 degrees",
    "images mirrored": "the images are mirrored: switch off the horizontal flip of the camera's driver",
    "images flipped": "the images are flipped upside down (mirrored): switch off the flip of the driver",
    "images turned left": _TURNED,
    "images turned right": _TURNED,
    "optical frame": "the camera's mount is that of its housing (x forward), not of its optical frame (z "
    "forward): use the optical frame, or give the mount in a rig file",
    "wheels": "the wheel odometry contradicts lidar and camera, which agree: correct its signs or axes in "
    "the driver",
    "lidar mirrored": "the lidar is mirrored (upside down, or angles counted the other way): correct its "
    "mounting in the rig file",
    "lidar turned": "the lidar is turned round by 180 degrees: correct its mounting in the rig file",
    "lidar mirrored and turned": "the lidar is mirrored and turned round by 180 degrees: correct its "
    "mounting in the rig file",
}


def sentence(evidence: Evidence, camera_px: tuple[float, float, float, float]) -> str:
    """Return one sentence on a gross fault: cause, amount, evidence and remedy.

    `camera_px`: (fx, fy, cx, cy) as stated, in pixels of the camera's images.
    """
    values, cause = evidence.best.values, evidence.cause
    fx, fy, cx, cy = camera_px
    if cause == "principal point":
        x, y = cx + fx * values["shift_x"], cy + fy * values["shift_y"]
        text = (
            f"the principal point is wrong: ({x:.0f}, {y:.0f}) px fits, K states ({cx:.0f}, {cy:.0f}) px: "
            "the images are a part (region of interest) of those for which K was calibrated; calibrate at "
            "this size"
        )
    elif cause in ("K", "K of another size"):
        factor = float(np.exp(values.get("log_focal", 0.0) + values.get("size", 0.0)))
        other = "images of another size" if cause == "K of another size" else "another lens"
        text = (
            f"K is wrong: fx = {fx * factor:.0f} px fits, K states {fx:.0f} px: it belongs to {other}; "
            "calibrate the camera at this size"
        )
    elif cause == "distortion":
        text = (
            f"the lens distortion is missing or wrong (k1 = {values['k1']:+.2f} in addition fits): calibrate "
            "the camera with its distortion, or publish rectified images"
        )
    elif cause == "lidar yaw":
        text = (
            f"the lidar's yaw is wrong: turn its mount by {np.degrees(evidence.lidar_turn_rad):.0f} degrees "
            "in the rig file"
        )
    else:
        text = _REMEDIES[cause]
    if evidence.alternatives:
        others = " or ".join(evidence.alternatives)
        text += f" (without wheel odometry this is not told from: {others})"
    return f"{text} ({evidence.best.cost:.2f} instead of {evidence.against:.2f} of misfit)"
