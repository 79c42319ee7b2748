"""Gaussians in arrays that grow, and Adam on those that were seen."""

from __future__ import annotations

import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.common.raster.lanes import exp2_lanes
from beamsplat.common.raster.layout import COLOUR, GRADIENTS, MEAN, OPACITY, PARAMS, QUAT, SCALE, WEIGHT
from beamsplat.common.raster.rasterizer import Gradients
from beamsplat.common.raster.simd import LANES, any_lane, fma, larger, repeat, root, smaller, where
from beamsplat.common.raster.simd_memory import atomic_next, gather, load, scatter_some
from beamsplat.common.raster.threads import Team

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-15
_LOG2_BETA_1, _LOG2_BETA_2 = float(np.log2(BETA_1)), float(np.log2(BETA_2))


class GaussianArrays:
    """Columns 0 ... count of every array are Gaussians; rows of `params` as in `layout`."""

    def __init__(self, capacity: int = 4096) -> None:
        self.count = 0
        self._allocate(-(-capacity // 16) * 16)

    def _allocate(self, capacity: int) -> None:
        self.params = np.zeros((PARAMS, capacity), np.float32)
        self.first = np.zeros((PARAMS, capacity), np.float32)  # Adam's moments
        self.second = np.zeros((PARAMS, capacity), np.float32)
        self.steps = np.zeros(capacity, np.float32)  # of Adam, each Gaussian its own

    def _arrays(self) -> list[str]:
        """Names of all arrays; `params` first."""
        return ["params", "first", "second", "steps"]

    @property
    def capacity(self) -> int:
        """Columns that fit without growing."""
        return self.params.shape[1]

    def append(self, params: np.ndarray) -> slice:
        """Adds Gaussians float32 [PARAMS, M], everything else of them zero; gives their columns."""
        new = params.shape[1]
        if self.count + new > self.capacity:
            self.resize(max(self.count + new, 2 * self.capacity))
        at = slice(self.count, self.count + new)
        for name in self._arrays()[1:]:
            getattr(self, name)[..., at] = 0
        self.params[:, at] = params
        self.count += new
        return at

    def resize(self, capacity: int) -> None:
        """Room for at least so many, none for more: array by array, so that two of them at most stand beside
        each other."""
        capacity = -(-max(capacity, self.count, 16) // 16) * 16
        for name in self._arrays():
            old = getattr(self, name)
            new = np.zeros((*old.shape[:-1], capacity), old.dtype)
            new[..., : self.count] = old[..., : self.count]
            setattr(self, name, new)

    def keep(self, mask: np.ndarray) -> int:
        """Drops Gaussians whose flag in bool [count] is unset, the rest keep their order; gives how many."""
        chosen = np.flatnonzero(mask)
        dropped = self.count - len(chosen)
        if dropped:
            for name in self._arrays():
                array = getattr(self, name)
                array[..., : len(chosen)] = array[..., chosen]
            self.count = len(chosen)
        return dropped

    def step(
        self,
        team: Team,
        gradients: Gradients,
        rates: np.ndarray,  # float32 [PARAMS], as `rate_rows` gives them
        isotropy: float = 0.0,
        ratio_log: float = 0.0,
    ) -> None:
        """One step of Adam on what was seen; `isotropy` and `ratio_log` as in `adam`."""
        team.run(
            adam, gradients.by_splat, gradients.index, self.params, self.first, self.second, self.steps,
            rates,  np.float32(isotropy), np.float32(ratio_log),
        )  # fmt: skip


@kernel
def adam(  # noqa: ANN201
    counter, gradients, index, params, first, second, steps, rates, isotropy, ratio_log,  # noqa: ANN001
):  # fmt: skip
    """One step of Adam on the Gaussians that were seen (Kingma & Ba 2015), each with its own count of steps.

    Args:
        gradients: float32 [GRADIENTS, >= V]. index: int32 [>= V], padded. params, first, second: float32
            [PARAMS, capacity]. steps: float32 [capacity]. rates: float32 [PARAMS].
        isotropy: pulls the longest axis towards the second where it is more than e**ratio_log as long, in
            proportion to the Gaussian's share of the picture: needles show from other views.
    """
    visible, stride = len(index), params.shape[1]
    g_flat, p_flat, m_flat, v_flat = (
        gradients.reshape(-1),
        params.reshape(-1),
        first.reshape(-1),
        second.reshape(-1),
    )
    wide = gradients.shape[1]
    block = 64 * LANES
    while True:
        begin = atomic_next(counter, 0) * block
        if begin >= visible:
            return
        for at in range(begin, min(visible, begin + block), LANES):
            if not any_lane(load(g_flat, WEIGHT * wide + at) > 0.0):  # hidden: nothing to learn
                continue
            used = min(LANES, visible - at)
            t = gather(steps, 0, index, at) + 1.0
            scatter_some(steps, 0, index, at, t, used)
            fix_1 = 1.0 / (1.0 - exp2_lanes(larger(t * _LOG2_BETA_1, -100.0)))
            fix_2 = 1.0 / (1.0 - exp2_lanes(larger(t * _LOG2_BETA_2, -100.0)))
            a = gather(p_flat, SCALE * stride, index, at)
            b = gather(p_flat, (SCALE + 1) * stride, index, at)
            c = gather(p_flat, (SCALE + 2) * stride, index, at)
            longest = larger(a, larger(b, c))
            middle = larger(smaller(a, b), smaller(larger(a, b), c))
            pull = larger(longest - middle - ratio_log, 0.0) * isotropy * load(g_flat, WEIGHT * wide + at)
            for row in range(PARAMS):
                g = load(g_flat, row * wide + at)
                p = gather(p_flat, row * stride, index, at)
                if SCALE <= row < QUAT:
                    g = g + where(p >= longest, pull, 0.0)
                m = gather(m_flat, row * stride, index, at)
                v = gather(v_flat, row * stride, index, at)
                m = fma(g - m, repeat(np.float32(1.0 - BETA_1)), m)
                v = fma(g * g - v, repeat(np.float32(1.0 - BETA_2)), v)
                scatter_some(m_flat, row * stride, index, at, m, used)
                scatter_some(v_flat, row * stride, index, at, v, used)
                move = m * fix_1 / (root(v * fix_2) + EPSILON)
                scatter_some(p_flat, row * stride, index, at, p - move * rates[row], used)


def rate_rows(mean: float, log_scale: float, quat: float, opacity: float, colour: float) -> np.ndarray:
    """float32 [PARAMS] of `adam` from one rate per group."""
    rows = np.empty(PARAMS, np.float32)
    rows[MEAN:SCALE], rows[SCALE:QUAT], rows[QUAT:OPACITY] = mean, log_scale, quat
    rows[OPACITY:COLOUR], rows[COLOUR:] = opacity, colour
    return rows


assert GRADIENTS > PARAMS
