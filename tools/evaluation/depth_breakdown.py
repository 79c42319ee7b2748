"""Errors of depth by parts of the image, with confidence intervals, and paired comparison of two methods."""

from __future__ import annotations

from typing import Any

import numpy as np

from beamsplat.tools.evaluation.bootstrap import (
    BLOCK_FRAMES,
    CONFIDENCE,
    RESAMPLES,
    interval,
    resample_blocks,
)
from beamsplat.tools.evaluation.image_parts import OUTSIDE, PARTS

NEAR_M = 0.05  # the map's F-score is at this distance, so depth is useful to it within this error
_BIN_M, _LIMIT_M = 0.005, 1.0  # histogram of signed errors, for their median; larger errors are in end bins
_BINS = round(2 * _LIMIT_M / _BIN_M) + 2
# Sums over the pixels of a part, in the order of the columns.
_TRUTH, _ANSWERED, _NEAR, _ABS, _REL, _SQUARE = range(6)
_WHOLE = ("absrel", "rmse_m", "l1_m", "delta1", "within_5cm", "coverage", "within_1sigma", "within_3sigma")


class DepthBreakdown:
    """Errors of one depth method over the images of a drive, by parts of the image."""

    def __init__(self) -> None:
        self._whole: list[np.ndarray] = []  # [len(_WHOLE)] per image, NaN if the image has no depth
        self._sums: dict[str, list[np.ndarray]] = {}  # [parts, 6] per image
        self._histograms: dict[str, list[np.ndarray]] = {}  # [parts, _BINS] per image

    def add(
        self,
        depth_m: np.ndarray,  # float32 [H, W], NaN = unknown
        sigma_m: np.ndarray | None,  # float32 [H, W]
        truth_m: np.ndarray,  # float32 [H, W], NaN = unknown
        labels: dict[str, np.ndarray],  # by grouping: int8 [H, W], number of the part, OUTSIDE = none
    ) -> None:
        """Add one image; images are added in the order of time."""
        self._whole.append(_image_figures(depth_m, sigma_m, truth_m))
        for grouping, label in labels.items():
            sums, histogram = _part_sums(depth_m, truth_m, label, len(PARTS[grouping]))
            self._sums.setdefault(grouping, []).append(sums)
            self._histograms.setdefault(grouping, []).append(histogram)

    def report(self) -> dict[str, Any]:
        """Return the figures: `whole` (means over images) and, by grouping, one row per part.

        Each figure with an interval is a pair of entries `name` and `name_interval` ([low, high], or None
        with too few blocks of images).
        """
        weights = resample_blocks(len(self._whole))
        out: dict[str, Any] = {"whole": self._whole_report(weights)}
        for grouping, per_image in self._sums.items():
            out[grouping] = _rows(
                PARTS[grouping], np.stack(per_image), np.stack(self._histograms[grouping]), weights
            )
        return out

    def _whole_report(self, weights: np.ndarray | None) -> dict[str, Any]:
        table = np.stack(self._whole) if self._whole else np.zeros((0, len(_WHOLE)))
        out: dict[str, Any] = {}
        for k, name in enumerate(_WHOLE):
            known = np.isfinite(table[:, k])
            value = float(table[known, k].mean()) if known.any() else None
            bounds = None
            if weights is not None and known.any():
                with np.errstate(invalid="ignore"):
                    means = weights[:, known] @ table[known, k] / weights[:, known].sum(axis=1)
                bounds = interval(means)
            out[name], out[f"{name}_interval"] = value, bounds
        return out


class PairedErrors:
    """Errors of two methods on the pixels that both answer, for the interval of their difference."""

    def __init__(self) -> None:
        self._sums: list[np.ndarray] = []  # [2, 6] per image

    def add(self, first_m: np.ndarray, second_m: np.ndarray, truth_m: np.ndarray) -> None:
        """Add one image: depth of both methods and true depth, float32 [H, W] in m, NaN = unknown."""
        both = np.isfinite(first_m) & np.isfinite(second_m)
        label = np.where(np.isfinite(truth_m), 0, OUTSIDE).astype(np.int8)
        masked = [np.where(both, depth, np.float32(np.nan)) for depth in (first_m, second_m)]
        self._sums.append(np.concatenate([_part_sums(depth, truth_m, label, 1)[0] for depth in masked]))

    def report(self) -> dict[str, Any]:
        """Return the figures of both, pooled over pixels, and the change from the first to the second.

        Changes are relative (-0.1 = 10 % smaller), but for `within_5cm` the difference.
        """
        sums = np.stack(self._sums) if self._sums else np.zeros((0, 2, 6))
        weights = resample_blocks(len(sums))
        total = sums.sum(axis=0)
        drawn = None if weights is None else np.einsum("rf,fmk->rmk", weights, sums)
        pixels = float(total[0, _ANSWERED])
        out: dict[str, Any] = {"pixels": pixels, "coverage": pixels / max(total[0, _TRUTH], 1.0)}
        for name, column in (("absrel", _REL), ("l1_m", _ABS), ("rmse_m", _SQUARE), ("within_5cm", _NEAR)):
            first, second = _figure(total, column).tolist()
            out[name] = {
                "first": first, "second": second, "change": float(_change(total, column)),
                "change_interval": None if drawn is None else interval(_change(drawn, column)),
            }  # fmt: skip
        return out


def breakdown_report(breakdowns: dict[str, DepthBreakdown], heights: dict[str, Any]) -> dict[str, Any]:
    """Return the JSON object `breakdown` of `beamsplat eval depth`; `heights` says how heights were found."""
    return {
        "heights": heights, "block_frames": BLOCK_FRAMES, "resamples": RESAMPLES, "confidence": CONFIDENCE,
        "methods": {name: breakdown.report() for name, breakdown in breakdowns.items()},
    }  # fmt: skip


def _image_figures(depth_m: np.ndarray, sigma_m: np.ndarray | None, truth_m: np.ndarray) -> np.ndarray:
    """Return the figures `_WHOLE` of one image, float64; NaN where it has no depth."""
    there = np.isfinite(truth_m)
    ok = there & np.isfinite(depth_m)
    out = np.full(len(_WHOLE), np.nan)
    out[_WHOLE.index("coverage")] = ok.sum() / max(there.sum(), 1)
    if not ok.any():
        return out
    z, t = depth_m[ok].astype(np.float64), truth_m[ok].astype(np.float64)
    error = np.abs(z - t)
    figures = {
        "absrel": np.mean(error / t), "rmse_m": np.sqrt(np.mean(error**2)), "l1_m": error.mean(),
        "delta1": np.mean(np.maximum(z / t, t / z) < 1.25), "within_5cm": np.mean(error < NEAR_M),
    }  # fmt: skip
    if sigma_m is not None:
        sigma = sigma_m[ok]
        figures |= {"within_1sigma": np.mean(error <= sigma), "within_3sigma": np.mean(error <= 3.0 * sigma)}
    for name, value in figures.items():
        out[_WHOLE.index(name)] = value
    return out


def _part_sums(
    depth_m: np.ndarray, truth_m: np.ndarray, label: np.ndarray, parts: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return, for each part, sums float64 [parts, 6] and the histogram of signed errors [parts, _BINS]."""
    inside = label != OUTSIDE
    sums = np.zeros((parts, 6))
    sums[:, _TRUTH] = np.bincount(label[inside], minlength=parts)
    ok = inside & np.isfinite(depth_m)
    part = label[ok].astype(np.int64)
    truth = truth_m[ok].astype(np.float64)
    error = depth_m[ok] - truth
    size = np.abs(error)
    for column, values in (
        (_ANSWERED, None), (_NEAR, size < NEAR_M), (_ABS, size), (_REL, size / truth), (_SQUARE, error**2),
    ):  # fmt: skip
        sums[:, column] = np.bincount(part, values, minlength=parts)
    bins = np.clip(np.floor((error + _LIMIT_M) / _BIN_M).astype(np.int64) + 1, 0, _BINS - 1)
    histogram = np.bincount(part * _BINS + bins, minlength=parts * _BINS).reshape(parts, _BINS)
    return sums, histogram.astype(np.float64)


def _rows(
    names: tuple[str, ...],
    sums: np.ndarray,  # [images, parts, 6]
    histograms: np.ndarray,  # [images, parts, _BINS]
    weights: np.ndarray | None,  # [resamples, images]
) -> list[dict[str, Any]]:
    total = sums.sum(axis=0)
    figures = _part_figures(total, histograms.sum(axis=0))
    bounds: dict[str, list[list[float] | None]] = {}
    if weights is not None:
        drawn = np.einsum("rf,fpk->rpk", weights, sums)
        medians = np.stack(
            [_median(weights @ histograms[:, part]) for part in range(len(names))], axis=1
        )  # one part at a time, because all resampled histograms together are large
        resampled = _part_figures(drawn, None) | {"median_m": medians}
        bounds = {
            name: [interval(values[:, part]) for part in range(len(names))]
            for name, values in resampled.items()
        }
    rows = []
    for part, name in enumerate(names):
        row: dict[str, Any] = {
            "part": name,
            "share": float(total[part, _TRUTH] / max(total[:, _TRUTH].sum(), 1.0)),
        }
        for key, values in figures.items():
            value = float(values[part])
            row[key] = value if np.isfinite(value) else None
            if key != "coverage":
                row[f"{key}_interval"] = bounds[key][part] if bounds else None
        rows.append(row)
    return rows


def _part_figures(sums: np.ndarray, histograms: np.ndarray | None) -> dict[str, np.ndarray]:
    """Return the figures of all parts, each [..., parts], from sums [..., parts, 6]."""
    with np.errstate(divide="ignore", invalid="ignore"):
        answered = sums[..., _ANSWERED]
        figures = {
            "coverage": answered / sums[..., _TRUTH], "within_5cm": sums[..., _NEAR] / answered,
            "share_of_l1": sums[..., _ABS] / sums[..., _ABS].sum(axis=-1, keepdims=True),
            "l1_m": sums[..., _ABS] / answered, "absrel": sums[..., _REL] / answered,
        }  # fmt: skip
    return figures if histograms is None else figures | {"median_m": _median(histograms)}


def _median(counts: np.ndarray) -> np.ndarray:
    """Return the medians [...] (m) of errors from histograms [..., _BINS]; NaN of empty histograms.

    Medians beyond 1 m are returned as 1 m.
    """
    cumulative = np.cumsum(counts, axis=-1)
    half = 0.5 * cumulative[..., -1:]
    k = np.argmax(cumulative >= half, axis=-1)[..., None]
    here = np.take_along_axis(counts, k, axis=-1)
    before = np.take_along_axis(cumulative, k, axis=-1) - here
    with np.errstate(divide="ignore", invalid="ignore"):
        place = (k - 1 + (half - before) / here) * _BIN_M - _LIMIT_M
    place = np.where(half > 0.0, np.clip(place, -_LIMIT_M, _LIMIT_M), np.nan)
    return place[..., 0]


def _figure(sums: np.ndarray, column: int) -> np.ndarray:
    """Return a figure [..., 2] of both methods from sums [..., 2, 6]."""
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = sums[..., column] / sums[..., _ANSWERED]
    return np.sqrt(mean) if column == _SQUARE else mean


def _change(sums: np.ndarray, column: int) -> np.ndarray:
    figure = _figure(sums, column)
    if column == _NEAR:
        return figure[..., 1] - figure[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        return figure[..., 1] / figure[..., 0] - 1.0
