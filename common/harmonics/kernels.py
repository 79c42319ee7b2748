"""Compiled kernels of view-dependent colours: evaluation, gradient and optimisation on the CPU."""

from __future__ import annotations

import numpy as np

from beamsplat.common.compiled import inner, kernel
from beamsplat.common.harmonics.basis import C1, C2, C3
from beamsplat.common.raster.layout import COLOUR, MEAN, WEIGHT
from beamsplat.common.raster.optimiser import BETA_1, BETA_2, EPSILON


@inner
def _basis(count: int, x: float, y: float, z: float, out: np.ndarray) -> None:
    """Write the first `count` basis functions at a unit vector to `out`, see `basis`."""
    xx, yy, zz = x * x, y * y, z * z
    out[0], out[1], out[2] = -C1 * y, C1 * z, -C1 * x
    if count > 3:
        out[3], out[4] = C2[0] * x * y, C2[1] * y * z
        out[5], out[6] = C2[2] * (2.0 * zz - xx - yy), C2[3] * x * z
        out[7] = C2[4] * (xx - yy)
    if count > 8:
        out[8], out[9] = C3[0] * y * (3.0 * xx - yy), C3[1] * x * y * z
        out[10], out[11] = C3[2] * y * (4.0 * zz - xx - yy), C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)
        out[12], out[13] = C3[4] * x * (4.0 * zz - xx - yy), C3[5] * z * (xx - yy)
        out[14] = C3[6] * x * (xx - 3.0 * yy)


@inner
def _basis_gradient(count: int, x: float, y: float, z: float, out: np.ndarray) -> None:
    """Write the derivatives of the polynomials with respect to x, y, z to `out` [count, 3]."""
    xx, yy, zz = x * x, y * y, z * z
    out[:count] = 0.0
    out[0, 1], out[1, 2], out[2, 0] = -C1, C1, -C1
    if count > 3:
        out[3, 0], out[3, 1] = C2[0] * y, C2[0] * x
        out[4, 1], out[4, 2] = C2[1] * z, C2[1] * y
        out[5, 0], out[5, 1], out[5, 2] = -2.0 * C2[2] * x, -2.0 * C2[2] * y, 4.0 * C2[2] * z
        out[6, 0], out[6, 2] = C2[3] * z, C2[3] * x
        out[7, 0], out[7, 1] = 2.0 * C2[4] * x, -2.0 * C2[4] * y
    if count > 8:
        out[8, 0], out[8, 1] = 6.0 * C3[0] * x * y, 3.0 * C3[0] * (xx - yy)
        out[9, 0], out[9, 1], out[9, 2] = C3[1] * y * z, C3[1] * x * z, C3[1] * x * y
        out[10, 0], out[10, 1] = -2.0 * C3[2] * x * y, C3[2] * (4.0 * zz - xx - 3.0 * yy)
        out[10, 2] = 8.0 * C3[2] * y * z
        out[11, 0], out[11, 1] = -6.0 * C3[3] * x * z, -6.0 * C3[3] * y * z
        out[11, 2] = C3[3] * (6.0 * zz - 3.0 * xx - 3.0 * yy)
        out[12, 0], out[12, 1] = C3[4] * (4.0 * zz - 3.0 * xx - yy), -2.0 * C3[4] * x * y
        out[12, 2] = 8.0 * C3[4] * x * z
        out[13, 0], out[13, 1], out[13, 2] = 2.0 * C3[5] * x * z, -2.0 * C3[5] * y * z, C3[5] * (xx - yy)
        out[14, 0], out[14, 1] = 3.0 * C3[6] * (xx - yy), -6.0 * C3[6] * x * y


@kernel
def shade(
    params: np.ndarray, harmonics: np.ndarray, count: int, centre_map_m: np.ndarray, out: np.ndarray
) -> None:
    """Write the colours that a camera sees to the rows COLOUR of `out`, for the first `count` Gaussians.

    Args:
        params, out: float32 [14, capacity]. harmonics: float32 [3 K, capacity]. centre_map_m: float64 [3], of
            the camera.
    """
    terms = len(harmonics) // 3
    value = np.empty(15)
    for i in range(count):
        x = params[MEAN, i] - centre_map_m[0]
        y = params[MEAN + 1, i] - centre_map_m[1]
        z = params[MEAN + 2, i] - centre_map_m[2]
        inverse = 1.0 / max(np.sqrt(x * x + y * y + z * z), 1e-9)
        _basis(terms, x * inverse, y * inverse, z * inverse, value)
        for channel in range(3):
            shown = float(params[COLOUR + channel, i])
            for k in range(terms):
                shown += harmonics[channel * terms + k, i] * value[k]
            out[COLOUR + channel, i] = shown


@kernel
def shade_backward(
    params: np.ndarray,
    harmonics: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    steps: np.ndarray,
    index: np.ndarray,
    gradients: np.ndarray,
    centre_map_m: np.ndarray,
    rate: float,
    centre_gradient: np.ndarray,
) -> None:
    """Go back from dL/d(colour) to coefficients and centres; with a rate above 0, take a step of Adam.

    Call it before `optimiser.adam`, which counts the step.

    Args:
        params: float32 [14, capacity]. harmonics, first, second: float32 [3 K, capacity], coefficients and
            Adam's moments. steps: float32 [capacity]. index: int32 [V]. gradients: float32 [16, V], in out.
        centre_map_m: float64 [3], of the camera. centre_gradient: out float64 [3], dL/d(centre_map_m).
    """
    terms = len(harmonics) // 3
    value, slope, along = np.empty(15), np.empty((15, 3)), np.empty(3)
    centre_gradient[:] = 0.0
    for column in range(len(index)):
        if not gradients[WEIGHT, column] > 0.0:
            continue
        i = index[column]
        x = params[MEAN, i] - centre_map_m[0]
        y = params[MEAN + 1, i] - centre_map_m[1]
        z = params[MEAN + 2, i] - centre_map_m[2]
        inverse = 1.0 / max(np.sqrt(x * x + y * y + z * z), 1e-9)
        x, y, z = x * inverse, y * inverse, z * inverse
        _basis(terms, x, y, z, value)
        _basis_gradient(terms, x, y, z, slope)
        along[:] = 0.0
        t = steps[i] + 1.0
        fix_1, fix_2 = 1.0 / (1.0 - BETA_1**t), 1.0 / (1.0 - BETA_2**t)
        for channel in range(3):
            seen = gradients[COLOUR + channel, column]
            for k in range(terms):
                row = channel * terms + k
                for axis in range(3):
                    along[axis] += seen * harmonics[row, i] * slope[k, axis]
                if rate > 0.0:
                    g = seen * value[k]
                    m = first[row, i] + (g - first[row, i]) * (1.0 - BETA_1)
                    v = second[row, i] + (g * g - second[row, i]) * (1.0 - BETA_2)
                    first[row, i], second[row, i] = m, v
                    harmonics[row, i] -= rate * m * fix_1 / (np.sqrt(v * fix_2) + EPSILON)
        # d = r / |r|: dd/dr = (I - d d^T) / |r|.
        radial = along[0] * x + along[1] * y + along[2] * z
        for axis, d in enumerate((x, y, z)):
            turned = (along[axis] - radial * d) * inverse
            gradients[MEAN + axis, column] += turned
            centre_gradient[axis] -= turned
