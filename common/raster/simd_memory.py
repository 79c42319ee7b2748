"""Memory operations on SIMD vectors (load, store, gather, scatter, sums, prefetch) and an atomic counter."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils

from beamsplat.common.raster.simd import F32, FLOAT, INT, IVEC, LANES, MASK, VEC, constant, shuffle
from beamsplat.common.raster.simd_types import Intrinsic, Vector, numba_signature, typed_intrinsic


@njit(nogil=True, error_model="numpy")
def aligned_floats(count: int) -> np.ndarray:
    """Return an uninitialised float32 [count] aligned to 64 bytes: no vector access crosses a cache line."""
    raw = np.empty(count + 16, np.float32)
    skip = (64 - raw.ctypes.data % 64) % 64 // 4
    return raw[skip : skip + count]


def _address(
    context: Any, builder: ir.IRBuilder, kind: types.Array, array: ir.Value, at: ir.Value
) -> ir.Value:
    data = context.make_array(kind)(context, builder, value=array).data
    return builder.gep(data, [at], inbounds=True)


def _aligned_load(builder: ir.IRBuilder, pointer: ir.Value, kind: ir.Type) -> ir.Value:
    value = builder.load(builder.bitcast(pointer, kind.as_pointer()), typ=kind)
    value.align = 4
    return value


@typed_intrinsic
def load(typingctx: Any, array: np.ndarray, at: int) -> Intrinsic[Vector]:
    """Return the vector (array[at], array[at + 1], ...) of a contiguous float32 array, unchecked."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        return _aligned_load(builder, _address(context, builder, sig.args[0], args[0], args[1]), VEC)

    return Intrinsic(numba_signature(F32, array, types.int64), emit)


@typed_intrinsic
def store(typingctx: Any, array: np.ndarray, at: int, value: Vector) -> Intrinsic[None]:
    """Write a vector to array[at], array[at + 1], ..., without bounds check."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        pointer = _address(context, builder, sig.args[0], args[0], args[1])
        builder.store(args[2], builder.bitcast(pointer, VEC.as_pointer()), align=4)
        return context.get_dummy_value()

    return Intrinsic(numba_signature(types.void, array, types.int64, F32), emit)


def _scattered(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
    """Return pointers to array[base + index[at + lane]], from the arguments (array, base, index, at, ...)."""
    lanes = _aligned_load(builder, _address(context, builder, sig.args[2], args[2], args[3]), IVEC)
    start = _address(context, builder, sig.args[0], args[0], args[1])
    pointers = builder.gep(start, [lanes], inbounds=False, source_etype=FLOAT)
    kind = ir.VectorType(start.type, LANES)
    pointers.type = kind
    return pointers


@typed_intrinsic
def gather(typingctx: Any, array: np.ndarray, base: int, index: np.ndarray, at: int) -> Intrinsic[Vector]:
    """Return the vector of array[base + index[at + lane]]; `index` is contiguous int32."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        pointers = _scattered(context, builder, sig, args)
        gathered = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(VEC, [pointers.type, INT, MASK, VEC]),
            f"llvm.masked.gather.v{LANES}f32.v{LANES}p0",
        )  # fmt: skip
        every = ir.Constant(MASK, [1] * LANES)
        return builder.call(gathered, [pointers, ir.Constant(INT, 4), every, constant(0.0)])

    return Intrinsic(numba_signature(F32, array, types.int64, index, types.int64), emit)


@typed_intrinsic
def scatter_some(
    typingctx: Any, array: np.ndarray, base: int, index: np.ndarray, at: int,
    value: Vector, count: int,
) -> Intrinsic[None]:  # fmt: skip
    """Write the first `count` lanes of a vector to array[base + index[at + lane]]; `index` is int32."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        pointers = _scattered(context, builder, sig, args)
        number = builder.insert_element(
            ir.Constant(IVEC, ir.Undefined), builder.trunc(args[5], INT), ir.Constant(INT, 0)
        )
        number = shuffle(builder, number, number, [0] * LANES)
        used = builder.icmp_signed("<", ir.Constant(IVEC, list(range(LANES))), number)
        scattered = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(ir.VoidType(), [VEC, pointers.type, INT, MASK]),
            f"llvm.masked.scatter.v{LANES}f32.v{LANES}p0",
        )  # fmt: skip
        builder.call(scattered, [args[4], pointers, ir.Constant(INT, 4), used])
        return context.get_dummy_value()

    return Intrinsic(
        numba_signature(types.void, array, types.int64, index, types.int64, F32, types.int64), emit
    )


@typed_intrinsic
def prefetch(typingctx: Any, array: np.ndarray, at: int) -> Intrinsic[None]:
    """Prefetch the cache line of array[at]."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        pointer = _address(context, builder, sig.args[0], args[0], args[1])
        kind = ir.FunctionType(ir.VoidType(), [pointer.type, INT, INT, INT])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(function, [pointer, *(ir.Constant(INT, value) for value in (0, 3, 1))])
        return context.get_dummy_value()

    return Intrinsic(numba_signature(types.void, array, types.int64), emit)


@typed_intrinsic
def atomic_next(typingctx: Any, counter: np.ndarray, at: int) -> Intrinsic[int]:
    """Atomically increment counter[at] of an int64 array, and return the value before."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        pointer = _address(context, builder, sig.args[0], args[0], args[1])
        return builder.atomic_rmw("add", pointer, ir.Constant(ir.IntType(64), 1), "monotonic")

    return Intrinsic(numba_signature(types.int64, counter, types.int64), emit)


@typed_intrinsic
def store_sums4(
    typingctx: Any, array: np.ndarray, at: int, a: Vector, b: Vector, c: Vector, d: Vector
) -> Intrinsic[None]:
    """Write the sums over all lanes of a, b, c and d to array[at : at + 4], by one tree of additions."""

    def emit(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
        quads = range(0, LANES, 4)
        low = [q + i for q in quads for i in (0, LANES, 1, LANES + 1)]
        high = [q + i for q in quads for i in (2, LANES + 2, 3, LANES + 3)]
        fold = lambda x, y, one, two: builder.fadd(  # noqa: E731
            shuffle(builder, x, y, one), shuffle(builder, x, y, two)
        )
        ab, cd = fold(args[2], args[3], low, high), fold(args[4], args[5], low, high)
        first = [q + i for q in quads for i in (0, 1, LANES, LANES + 1)]
        second = [q + i for q in quads for i in (2, 3, LANES + 2, LANES + 3)]
        sums, width = fold(ab, cd, first, second), LANES
        while width > 4:
            width //= 2
            sums = fold(sums, sums, list(range(width)), list(range(width, 2 * width)))
        kind = ir.VectorType(FLOAT, 4)
        pointer = _address(context, builder, sig.args[0], args[0], args[1])
        builder.store(sums, builder.bitcast(pointer, kind.as_pointer()), align=4)
        return context.get_dummy_value()

    return Intrinsic(numba_signature(types.void, array, types.int64, F32, F32, F32, F32), emit)
