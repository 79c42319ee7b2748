"""Checks of images and beams before fusion; each returns "ok" or one sentence."""

from __future__ import annotations

import cv2
import numpy as np

_SIDE = 64


class ImageCheck:
    """Check of each image of a sequence for wrong exposure and for a frozen camera."""

    def __init__(self, still_m: float = 0.10, still_rad: float = 0.05) -> None:
        self._still_m, self._still_rad = still_m, still_rad
        self._last: np.ndarray | None = None
        self._T_map_body: np.ndarray | None = None  # where the image last changed

    def check(self, image_rgb: np.ndarray, T_map_body: np.ndarray) -> str:
        """Return "ok", or the reason why this image uint8 [H, W, 3] must not be used.

        Because of noise, a live camera never returns the same image twice. An image identical to the previous
        one means a frozen camera if the robot has since moved by `still_m` or rotated by `still_rad`.
        """
        grey = cv2.resize(
            cv2.cvtColor(image_rgb, cv2.COLOR_RGB2GRAY), (_SIDE, _SIDE), interpolation=cv2.INTER_AREA
        )
        level = check_exposure(grey)
        sample = image_rgb[::7, ::7]
        same = self._last is not None and np.array_equal(sample, self._last)
        if not same or self._T_map_body is None:
            self._last, self._T_map_body = sample.copy(), T_map_body.copy()
            return level
        if level != "ok":
            return level
        moved = float(np.linalg.norm(T_map_body[:3, 3] - self._T_map_body[:3, 3]))
        turn_cos = (np.trace(self._T_map_body[:3, :3].T @ T_map_body[:3, :3]) - 1.0) / 2.0
        turned = float(np.arccos(np.clip(turn_cos, -1.0, 1.0)))
        if moved > self._still_m or turned > self._still_rad:
            return (
                f"the camera is frozen: the same image after {moved:.2f} m and {np.degrees(turned):.0f} deg"
            )
        return "ok"


def check_exposure(grey: np.ndarray) -> str:
    """Return "ok", or one sentence if an image uint8 [h, w] is too dark, too bright or without contrast."""
    if float(np.percentile(grey, 95)) < 12.0:
        return "the image is black"
    if float(np.percentile(grey, 15)) > 248.0:
        return "the image is overexposed"
    if float(np.percentile(grey, 98)) - float(np.percentile(grey, 2)) < 4.0:
        return "the image has no contrast: one grey everywhere"
    return "ok"


def check_beams(in_view: int, disagree_share: float | None, least: int = 8) -> str:
    """Return "ok", or the reason why the beams in view cannot determine the scale.

    Args:
        in_view: number of beams in the image.
        disagree_share: fraction of these beams that contradict the depth of past keyframes; None = unknown.
        least: smallest sufficient number of beams.
    """
    if in_view < least:
        return f"no beams in view ({in_view} of at least {least}): the scale is unknown"
    if disagree_share is not None and disagree_share > 0.6:
        return (
            f"{disagree_share:.0%} of the beams contradict the depth from past images: "
            "glass in front of the robot, a wrong pose, or a sensor that has moved on its mount"
        )
    return "ok"
