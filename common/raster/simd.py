"""SIMD vectors of float32 as a Numba type: kernels are vectorised explicitly, without LLVM's auto-vectoriser.

`F32` is a vector of `LANES` floats (16 with AVX-512, else 8: two SSE or NEON registers), `Mask` has one bit
per lane. Both are types of local variables only; arrays hold plain float32. Operators work lane by lane,
scalar operands are broadcast. LLVM maps the vectors to the instructions of the host, so one source runs on
all CPUs. The only fast-math flag is `contract` (fused multiply-add): results are reproducible bit by bit.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import llvmlite.binding as llvm
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import lower_builtin, models, register_model

from beamsplat.common.raster.simd_types import Intrinsic, LaneMask, Vector, VectorLike, typed_intrinsic

LANES = 16 if llvm.get_host_cpu_features().get("avx512f", False) else 8
FLOAT, INT, _BIT = ir.FloatType(), ir.IntType(32), ir.IntType(1)
VEC, IVEC, MASK = (ir.VectorType(kind, LANES) for kind in (FLOAT, INT, _BIT))
_FUSE = ("contract",)


class F32Type(types.Type):
    def __init__(self) -> None:
        super().__init__(name=f"f32x{LANES}")


class _MaskType(types.Type):
    def __init__(self) -> None:
        super().__init__(name=f"mask{LANES}")


F32, Mask = F32Type(), _MaskType()


@register_model(F32Type)
class _F32Model(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: types.Type) -> None:
        super().__init__(dmm, fe_type, VEC)


@register_model(_MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: types.Type) -> None:
        super().__init__(dmm, fe_type, MASK)


def constant(value: float) -> ir.Constant:
    return ir.Constant(VEC, [value] * LANES)


def _icon(value: int) -> ir.Constant:
    return ir.Constant(IVEC, [value] * LANES)


def shuffle(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, lanes: list[int]) -> ir.Value:
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(INT, len(lanes)), lanes))


def _repeat(builder: ir.IRBuilder, scalar: ir.Value) -> ir.Value:
    one = builder.insert_element(ir.Constant(VEC, ir.Undefined), scalar, ir.Constant(INT, 0))
    return shuffle(builder, one, one, [0] * LANES)


def _as_vector(builder: ir.IRBuilder, value: ir.Value) -> ir.Value:
    return value if value.type == VEC else _repeat(builder, value)


def _call(builder: ir.IRBuilder, name: str, *args: ir.Value) -> ir.Value:
    kind = ir.FunctionType(VEC, [a.type for a in args])
    return builder.call(
        cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f32"), list(args)
    )


# --- operators -------------------------------------------------------------------------------------

_PAIRS = ((F32, F32), (F32, types.float32), (types.float32, F32))


def _define(
    op: Callable, result: types.Type, emit: Callable[[ir.IRBuilder, ir.Value, ir.Value], ir.Value]
) -> None:
    infer_global(op)(type(f"_{op.__name__}", (ConcreteTemplate,), {
        "cases": [signature(result, a, b) for a, b in _PAIRS]}))  # fmt: skip

    def lower(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return emit(builder, _as_vector(builder, args[0]), _as_vector(builder, args[1]))

    for a, b in _PAIRS:
        lower_builtin(op, a, b)(lower)


def _compare(sign: str) -> Callable[[ir.IRBuilder, ir.Value, ir.Value], ir.Value]:
    return lambda builder, a, b: builder.fcmp_ordered(sign, a, b)


_define(operator.add, F32, lambda builder, a, b: builder.fadd(a, b, flags=_FUSE))
_define(operator.sub, F32, lambda builder, a, b: builder.fsub(a, b, flags=_FUSE))
_define(operator.mul, F32, lambda builder, a, b: builder.fmul(a, b, flags=_FUSE))
_define(operator.truediv, F32, lambda builder, a, b: builder.fdiv(a, b))
_define(operator.lt, Mask, _compare("<"))
_define(operator.gt, Mask, _compare(">"))
_define(operator.le, Mask, _compare("<="))
_define(operator.ge, Mask, _compare(">="))


@infer_global(operator.neg)
class _Negate(ConcreteTemplate):
    cases = (signature(F32, F32),)


@lower_builtin(operator.neg, F32)
def _negate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
    return builder.fneg(args[0])


@infer_global(operator.and_)
class _And(ConcreteTemplate):
    cases = (signature(Mask, Mask, Mask),)


@lower_builtin(operator.and_, Mask, Mask)
def _and(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
    return builder.and_(*args)


# --- lane functions --------------------------------------------------------------------------------


@typed_intrinsic
def broadcast(typingctx: Any, value: float | np.floating) -> Intrinsic[Vector]:
    """Return a vector with the scalar in all lanes."""
    return Intrinsic(F32(types.float32), lambda context, builder, sig, args: _repeat(builder, args[0]))


@typed_intrinsic
def iota(typingctx: Any) -> Intrinsic[Vector]:
    """Return the vector (0, 1, 2, ...)."""
    lanes = ir.Constant(VEC, [float(i) for i in range(LANES)])
    return Intrinsic(F32(), lambda context, builder, sig, args: lanes)


@typed_intrinsic
def where(typingctx: Any, mask: LaneMask, yes: VectorLike, no: VectorLike) -> Intrinsic[Vector]:
    """Return a vector with the lanes of `yes` where the mask is set, of `no` elsewhere."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return builder.select(args[0], _as_vector(builder, args[1]), _as_vector(builder, args[2]))

    return Intrinsic(F32(Mask, *_kinds(yes, no)), emit)


def _kinds(*given: Any) -> list[types.Type]:
    return [F32 if g == F32 else types.float32 for g in given]


def _lower(emit: Callable[..., ir.Value]) -> Callable[..., ir.Value]:
    return lambda context, builder, sig, args: emit(builder, *(_as_vector(builder, a) for a in args))


def _unary(emit: Callable[..., ir.Value]) -> Callable[[VectorLike], Vector]:
    def declare(typingctx: Any, a: VectorLike) -> Intrinsic[Vector]:
        return Intrinsic(F32(*_kinds(a)), _lower(emit))

    return typed_intrinsic(declare)


def _binary(emit: Callable[..., ir.Value]) -> Callable[[VectorLike, VectorLike], Vector]:
    def declare(typingctx: Any, a: VectorLike, b: VectorLike) -> Intrinsic[Vector]:
        return Intrinsic(F32(*_kinds(a, b)), _lower(emit))

    return typed_intrinsic(declare)


def _ternary(emit: Callable[..., ir.Value]) -> Callable[[VectorLike, VectorLike, VectorLike], Vector]:
    def declare(typingctx: Any, a: VectorLike, b: VectorLike, c: VectorLike) -> Intrinsic[Vector]:
        return Intrinsic(F32(*_kinds(a, b, c)), _lower(emit))

    return typed_intrinsic(declare)


def _mantissa(builder: ir.IRBuilder, v: ir.Value) -> ir.Value:
    bits = builder.and_(builder.bitcast(v, IVEC), _icon(0x007FFFFF))
    return builder.bitcast(builder.or_(bits, _icon(0x3F800000)), VEC)


def _exponent(builder: ir.IRBuilder, v: ir.Value) -> ir.Value:
    bits = builder.lshr(builder.bitcast(v, IVEC), _icon(23))
    return builder.sitofp(builder.sub(bits, _icon(127)), VEC)


def _exp2_scale(builder: ir.IRBuilder, value: ir.Value, shifted: ir.Value) -> ir.Value:
    exponent_bits = builder.shl(builder.bitcast(shifted, IVEC), _icon(23))
    return builder.bitcast(builder.add(builder.bitcast(value, IVEC), exponent_bits), VEC)


def _reciprocal(builder: ir.IRBuilder, v: ir.Value) -> ir.Value:
    if LANES != 16:
        return builder.fdiv(constant(1.0), v)
    kind = ir.FunctionType(VEC, [VEC, VEC, ir.IntType(16)])
    estimate = cgutils.get_or_insert_function(builder.module, kind, "llvm.x86.avx512.rcp14.ps.512")
    r = builder.call(estimate, [v, constant(0.0), ir.Constant(ir.IntType(16), 0xFFFF)])
    two_minus = _call(builder, "fmuladd", builder.fneg(v), r, constant(2.0))  # one step of Newton
    return builder.fmul(r, two_minus)


fma = _ternary(lambda builder, a, b, c: _call(builder, "fmuladd", a, b, c))
minimum = _binary(lambda builder, a, b: builder.select(builder.fcmp_ordered("<", a, b), a, b))
maximum = _binary(lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b))
sqrt = _unary(lambda builder, a: _call(builder, "sqrt", a))
floor = _unary(lambda builder, a: _call(builder, "floor", a))
absolute = _unary(lambda builder, a: _call(builder, "fabs", a))
exp2_scale = _binary(_exp2_scale)  # value * 2**n, n in the low bits of shifted = n + 1.5 * 2**23
reciprocal = _unary(_reciprocal)  # 1/v with error 1e-7; undefined for zero and infinity
mantissa = _unary(_mantissa)  # in [1, 2), of positive normal numbers
exponent = _unary(_exponent)  # floor(log2(v)) of positive normal numbers


@typed_intrinsic
def any_lane(typingctx: Any, mask: LaneMask) -> Intrinsic[bool]:
    """Return whether any lane of the mask is set."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        bits = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))

    return Intrinsic(types.boolean(Mask), emit)
