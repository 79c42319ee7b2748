"""Growable arrays of Gaussians, and the Adam optimiser for the visible ones."""

from __future__ import annotations

import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.common.raster.layout import COLOUR, GRADIENTS, MEAN, OPACITY, PARAMS, QUAT, SCALE, WEIGHT
from beamsplat.common.raster.rasterizer import Gradients
from beamsplat.common.raster.simd import LANES, any_lane, broadcast, fma, maximum, minimum, sqrt, where
from beamsplat.common.raster.simd_math import exp2_lanes
from beamsplat.common.raster.simd_memory import atomic_next, gather, load, scatter_some
from beamsplat.common.raster.threads import ThreadTeam

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-15
_LOG2_BETA_1, _LOG2_BETA_2 = float(np.log2(BETA_1)), float(np.log2(BETA_2))


class GaussianArrays:
    """Parameters and Adam optimiser state of Gaussians in growable arrays.

    Columns 0 to count - 1 of each array are in use, one per Gaussian. The rows of `params` are defined in
    `raster.layout`: mean, log scale, quaternion, opacity logit, colour.
    """

    def __init__(self, capacity: int = 4096) -> None:
        self.count = 0
        self._allocate(-(-capacity // 16) * 16)

    def _allocate(self, capacity: int) -> None:
        self.params = np.zeros((PARAMS, capacity), np.float32)
        self.first = np.zeros((PARAMS, capacity), np.float32)  # Adam's first moments
        self.second = np.zeros((PARAMS, capacity), np.float32)  # Adam's second moments
        self.steps = np.zeros(capacity, np.float32)  # Adam steps of each Gaussian

    def _arrays(self) -> list[str]:
        """Return the attribute names of all arrays, `params` first."""
        return ["params", "first", "second", "steps"]

    @property
    def capacity(self) -> int:
        """Number of allocated columns."""
        return self.params.shape[1]

    def append(self, params: np.ndarray) -> slice:
        """Append Gaussians float32 [PARAMS, M] with zero optimiser state; return their columns as a slice."""
        new = params.shape[1]
        if self.count + new > self.capacity:
            self.resize(max(self.count + new, 2 * self.capacity))
        at = slice(self.count, self.count + new)
        for name in self._arrays()[1:]:
            self._write(name, at, 0)
        self._write("params", at, params)
        self.count += new
        return at

    def _write(self, name: str, at: slice, values: np.ndarray | int) -> None:
        """Set the columns `at` of an array."""
        getattr(self, name)[..., at] = values

    def resize(self, capacity: int) -> None:
        """Resize all arrays to `capacity` Gaussians, at least `count`, rounded up to a multiple of 16.

        Arrays are reallocated one at a time, so peak memory is one extra array.
        """
        capacity = -(-max(capacity, self.count, 16) // 16) * 16
        for name in self._arrays():
            old = getattr(self, name)
            new = np.zeros((*old.shape[:-1], capacity), old.dtype)
            new[..., : self.count] = old[..., : self.count]
            setattr(self, name, new)

    def keep(self, mask: np.ndarray) -> int:
        """Remove the Gaussians where `mask` bool [count] is False, and return their number.

        The others stay in the same order.
        """
        chosen = np.flatnonzero(mask)
        dropped = self.count - len(chosen)
        if dropped:
            self._compact(chosen)
            self.count = len(chosen)
        return dropped

    def _compact(self, chosen: np.ndarray) -> None:
        """Move the columns `chosen`, ascending, to the front of all arrays."""
        for name in self._arrays():
            array = getattr(self, name)
            array[..., : len(chosen)] = array[..., chosen]

    def step(
        self,
        team: ThreadTeam,
        gradients: Gradients,
        rates: np.ndarray,  # float32 [PARAMS], see `learning_rates`
        isotropy: float = 0.0,
        ratio_log: float = 0.0,
    ) -> None:
        """Take one Adam step on the visible Gaussians.

        Args:
            team: threads that run the kernel.
            gradients: result of `Rasterizer.backward`.
            rates: learning rate of each parameter row, float32 [PARAMS] (see `learning_rates`).
            isotropy: weight of the isotropic regularisation, see `adam`.
            ratio_log: logarithm of the axis ratio above which it acts, see `adam`.
        """
        team.run(
            adam, gradients.by_splat, gradients.index, self.params, self.first, self.second, self.steps,
            rates,  np.float32(isotropy), np.float32(ratio_log),
        )  # fmt: skip


@kernel
def adam(
    counter: np.ndarray,
    gradients: np.ndarray,
    index: np.ndarray,
    params: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    steps: np.ndarray,
    rates: np.ndarray,
    isotropy: np.float32,
    ratio_log: np.float32,
) -> None:
    """Take one Adam step (Kingma & Ba 2015) on the visible Gaussians; each one has its own step count.

    Args:
        gradients: float32 [GRADIENTS, >= V]. index: int32 [>= V], padded. params, first, second: float32
            [PARAMS, capacity]. steps: float32 [capacity]. rates: float32 [PARAMS].
        isotropy: weight of a gradient that shortens the longest axis where it is more than e**ratio_log times
            the second longest, in proportion to the Gaussian's blending weight in the image. It prevents
            needle shapes, which are visible as artefacts from other views.
        ratio_log: ln of the allowed ratio of the longest to the second longest axis.
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
            if not any_lane(load(g_flat, WEIGHT * wide + at) > 0.0):  # all occluded: no step
                continue
            used = min(LANES, visible - at)
            t = gather(steps, 0, index, at) + 1.0
            scatter_some(steps, 0, index, at, t, used)
            fix_1 = 1.0 / (1.0 - exp2_lanes(maximum(t * _LOG2_BETA_1, -100.0)))
            fix_2 = 1.0 / (1.0 - exp2_lanes(maximum(t * _LOG2_BETA_2, -100.0)))
            a = gather(p_flat, SCALE * stride, index, at)
            b = gather(p_flat, (SCALE + 1) * stride, index, at)
            c = gather(p_flat, (SCALE + 2) * stride, index, at)
            longest = maximum(a, maximum(b, c))
            middle = maximum(minimum(a, b), minimum(maximum(a, b), c))
            pull = maximum(longest - middle - ratio_log, 0.0) * isotropy * load(g_flat, WEIGHT * wide + at)
            for row in range(PARAMS):
                g = load(g_flat, row * wide + at)
                p = gather(p_flat, row * stride, index, at)
                if SCALE <= row < QUAT:
                    g = g + where(p >= longest, pull, 0.0)
                m = gather(m_flat, row * stride, index, at)
                v = gather(v_flat, row * stride, index, at)
                m = fma(g - m, broadcast(np.float32(1.0 - BETA_1)), m)
                v = fma(g * g - v, broadcast(np.float32(1.0 - BETA_2)), v)
                scatter_some(m_flat, row * stride, index, at, m, used)
                scatter_some(v_flat, row * stride, index, at, v, used)
                move = m * fix_1 / (sqrt(v * fix_2) + EPSILON)
                scatter_some(p_flat, row * stride, index, at, p - move * rates[row], used)


def learning_rates(mean: float, log_scale: float, quat: float, opacity: float, colour: float) -> np.ndarray:
    """Return the learning rate of each parameter row, float32 [PARAMS], from one rate per parameter group."""
    rows = np.empty(PARAMS, np.float32)
    rows[MEAN:SCALE], rows[SCALE:QUAT], rows[QUAT:OPACITY] = mean, log_scale, quat
    rows[OPACITY:COLOUR], rows[COLOUR:] = opacity, colour
    return rows


assert GRADIENTS > PARAMS
