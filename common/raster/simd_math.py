"""Mathematical functions on SIMD vectors: exp2, log2, exp, sigmoid."""

from __future__ import annotations

from beamsplat.common.compiled import inlined
from beamsplat.common.raster.simd import exp2_scale, exponent, fma, mantissa, maximum, minimum, where
from beamsplat.common.raster.simd_types import Vector

LOG2_E = 1.4426950408889634
LN_2 = 0.6931471805599453


_ROUND = 12582912.0  # 1.5 * 2**23: adding it rounds to the nearest integer, which is then in the low bits


@inlined
def exp2_lanes(x: Vector) -> Vector:
    """Return 2**x with a relative error of 2e-7 for x in [-126, 126]; undefined outside.

    Minimax polynomial (Lawson's iteration) on [-1/2, 1/2] in Estrin's scheme: its dependency chain is short,
    which matters more than the number of operations.
    """
    shifted = x + _ROUND
    f = x - (shifted - _ROUND)
    ff = f * f
    low = fma(f, 0.6931469440460205, 1.0000001192092896)
    middle = fma(f, 0.05550713092088699, 0.24022120237350464)
    high = fma(f, 0.001327647129073739, 0.009675540961325169)
    return exp2_scale(fma(ff, fma(ff, high, middle), low), shifted)


@inlined
def exp_lanes(x: Vector) -> Vector:
    """Return e**x, with the result clamped to 2**-120 .. 2**120."""
    return exp2_lanes(minimum(maximum(x * LOG2_E, -120.0), 120.0))


@inlined
def sigmoid_lanes(x: Vector) -> Vector:
    """Return 1 / (1 + e**-x)."""
    return 1.0 / (1.0 + exp_lanes(-x))


@inlined
def log2_lanes(x: Vector) -> Vector:
    """Return log2(x) of positive normal x with an absolute error of 2e-7 near 1 (series of atanh)."""
    m, e = mantissa(x), exponent(x)
    high = m > 1.4142135
    m = where(high, m * 0.5, m)
    e = where(high, e + 1.0, e)
    t = (m - 1.0) / (m + 1.0)
    tt = t * t
    p = fma(tt, 0.32059889, 0.41219858)
    p = fma(tt, p, 0.57707802)
    p = fma(tt, p, 0.96179669)
    p = fma(tt, p, 2.8853901)
    return fma(t, p, e)
