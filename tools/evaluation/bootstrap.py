"""Bootstrap over blocks of consecutive images: confidence intervals for figures of one drive.

Errors of neighbouring images are similar, because they show the same surfaces. So blocks of images, not
images or pixels, are drawn with replacement (block bootstrap, Kuensch 1989).
"""

from __future__ import annotations

import numpy as np

BLOCK_FRAMES = 5  # images with true depth per block; with one of eight images at 10 Hz: 4 s of a drive
RESAMPLES = 1000
CONFIDENCE = 0.95
MIN_BLOCKS = 5  # with fewer blocks, an interval says nothing


def resample_blocks(
    frames: int, block_frames: int = BLOCK_FRAMES, resamples: int = RESAMPLES, seed: int = 0
) -> np.ndarray | None:
    """Return how often each image is in each resample, float64 [resamples, frames].

    The images are in the order of time; the last block may be shorter. None if there are fewer than
    `MIN_BLOCKS` blocks.
    """
    blocks = -(-frames // block_frames)
    if blocks < MIN_BLOCKS:
        return None
    rng = np.random.default_rng(seed)
    drawn = rng.multinomial(blocks, np.full(blocks, 1.0 / blocks), size=resamples)
    return drawn[:, np.arange(frames) // block_frames].astype(np.float64)


def interval(values: np.ndarray, confidence: float = CONFIDENCE) -> list[float] | None:
    """Return [low, high], the percentile interval of the values [resamples] of a figure.

    None if the figure is undefined (NaN) in more than half of the resamples.
    """
    finite = values[np.isfinite(values)]
    if 2 * len(finite) < len(values) or len(finite) == 0:
        return None
    tail = 0.5 * (1.0 - confidence)
    low, high = np.quantile(finite, [tail, 1.0 - tail])
    return [float(low), float(high)]
