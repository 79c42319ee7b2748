"""Errors of depth maps: over all pixels with true depth, and at held-out beams."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


def every_third(count: int) -> np.ndarray:
    """Return bool [count], True for every third of `count` beams."""
    return np.arange(count) % 3 == 0


def every_third_block(count: int, increment_rad: float, width_rad: float = np.radians(7.5)) -> np.ndarray:
    """Return bool [count]: beams are divided into contiguous blocks, and every third block is True.

    `increment_rad` is the angle between beams, `width_rad` the angle that a block covers.
    """
    return np.floor(np.arange(count) * abs(increment_rad) / width_rad).astype(int) % 3 == 0


@dataclass
class MethodErrors:
    """Errors of one depth method, accumulated over the images of an evaluation."""

    frames: int = 0
    refused: int = 0
    rmse_m: list[float] = field(default_factory=list)
    absrel: list[float] = field(default_factory=list)
    delta1: list[float] = field(default_factory=list)
    coverage: list[float] = field(default_factory=list)
    within: list[tuple[float, float]] = field(default_factory=list)
    sigma_m: list[float] = field(default_factory=list)
    beam_square: float = 0.0
    beam_count: int = 0
    held: dict[str, list[np.ndarray]] = field(default_factory=dict)
    held_sigma: dict[str, list[np.ndarray]] = field(default_factory=dict)

    def add_dense(self, depth: np.ndarray, sigma: np.ndarray | None, truth: np.ndarray) -> None:
        """Add the errors of one depth map over all pixels with true depth.

        Pixels without depth lower the coverage and do not change any other metric.

        Args:
            depth: optical z float32 [H, W] in m, NaN where the method has no depth.
            sigma: standard deviation of the depth, float32 [H, W] in m; None if the method has none.
            truth: true optical z float32 [H, W] in m, NaN where unknown.
        """
        self.frames += 1
        there = np.isfinite(truth)
        ok = there & np.isfinite(depth)
        self.coverage.append(float(ok.sum() / max(there.sum(), 1)))
        if not ok.any():
            self.refused += 1
            return
        z, t = depth[ok].astype(np.float64), truth[ok].astype(np.float64)
        error = z - t
        self.rmse_m.append(float(np.sqrt(np.mean(error**2))))
        self.absrel.append(float(np.mean(np.abs(error) / t)))
        self.delta1.append(float(np.mean(np.maximum(z / t, t / z) < 1.25)))
        if sigma is not None:
            s = sigma[ok]
            self.within.append((float(np.mean(np.abs(error) <= s)), float(np.mean(np.abs(error) <= 3 * s))))
            self.sigma_m.append(float(np.median(s)))

    def add_beams(self, depth: np.ndarray, uv: np.ndarray, z: np.ndarray) -> None:
        """Add the errors of one depth map at lidar beams (the paper's Table IV).

        Args:
            depth: optical z float32 [H, W] in m.
            uv: pixels of the beams, float [N, 2].
            z: optical z of the beams, float [N], m.
        """
        error = at_pixels(depth, uv) - z
        error = error[np.isfinite(error)]
        self.beam_square += float(error @ error)
        self.beam_count += len(error)

    def add_held(
        self, run: str, depth: np.ndarray, sigma: np.ndarray | None, uv: np.ndarray, z: np.ndarray
    ) -> None:
        """Add the errors of one depth map at held-out beams that the true depth confirms.

        Args:
            run: how beams were held out: "third" (every third beam) or "blocks" (every third block).
            depth: optical z float32 [H, W] in m.
            sigma: standard deviation of the depth, float32 [H, W] in m; None if the method has none.
            uv: pixels of the beams, float [N, 2].
            z: optical z of the beams, float [N], m.
        """
        error = np.abs(at_pixels(depth, uv) - z)
        ok = np.isfinite(error)
        self.held.setdefault(run, []).append(error[ok])
        if sigma is not None:
            self.held_sigma.setdefault(run, []).append(at_pixels(sigma, uv)[ok])

    def summary(self, excluded: dict[str, float]) -> dict[str, float | int | None]:
        """Return the metrics by name (names of lengths end with _m); None where no data contributed.

        `excluded` is the ratio of held-out beams that the true depth does not confirm, by `run` of
        `add_held`.
        """
        out: dict[str, float | int | None] = {
            "frames": self.frames,
            "frames_refused": self.refused,
            "rmse_m": _mean(self.rmse_m),
            "absrel": _mean(self.absrel),
            "delta1": _mean(self.delta1),
            "coverage": _mean(self.coverage),
            "beams_rmse_m": float(np.sqrt(self.beam_square / self.beam_count)) if self.beam_count else None,
            "dense_within_1sigma": _mean([a for a, _ in self.within]),
            "dense_within_3sigma": _mean([b for _, b in self.within]),
            "sigma_median_m": _mean(self.sigma_m),
        }
        for run, prefix in (("third", "heldout"), ("blocks", "heldout_blocks")):
            error = np.concatenate(self.held.get(run) or [np.zeros(0)])
            sigma = np.concatenate(self.held_sigma.get(run) or [np.zeros(0)])
            out[f"{prefix}_beams"] = len(error)
            out[f"{prefix}_median_m"] = _quantile(error, 0.5)
            out[f"{prefix}_p90_m"] = _quantile(error, 0.9)
            out[f"{prefix}_excluded"] = excluded.get(run)
            known = len(sigma) == len(error) and len(error) > 0
            names = ("within_1sigma", "within_3sigma") if run == "third" else (
                "blocks_within_1sigma", "blocks_within_3sigma",
            )  # fmt: skip
            out[names[0]] = float(np.mean(error <= sigma)) if known else None
            out[names[1]] = float(np.mean(error <= 3.0 * sigma)) if known else None
        return out


def at_pixels(values: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Return float64 [N]: the values of an array [H, W] at the pixels nearest to uv [N, 2]."""
    h, w = values.shape
    v = np.clip(np.rint(uv[:, 1]).astype(int), 0, h - 1)
    u = np.clip(np.rint(uv[:, 0]).astype(int), 0, w - 1)
    return values[v, u].astype(np.float64)


def confirmed_by_truth(truth: np.ndarray, uv: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return bool [N]: for each beam, whether the true depth at its pixel confirms it.

    A beam is confirmed if both depths agree within 5 cm plus 2 % of the true depth.

    Args:
        truth: true optical z float32 [H, W] in m, NaN where unknown.
        uv: pixels of the beams, float [N, 2].
        z: optical z of the beams, float [N], m.
    """
    t = at_pixels(truth, uv)
    with np.errstate(invalid="ignore"):
        return np.abs(t - z) <= 0.05 + 0.02 * t


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _quantile(values: np.ndarray, q: float) -> float | None:
    return float(np.quantile(values, q)) if len(values) else None
