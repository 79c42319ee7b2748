"""Static types of the SIMD values in kernels, for type checkers.

They describe the arguments and results of the functions of `simd`; at run time the values exist in compiled
code only.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Concatenate, Generic, NamedTuple, ParamSpec, Protocol, TypeAlias, TypeVar

import numpy as np
from numba import types
from numba.extending import intrinsic

_P = ParamSpec("_P")
_R = TypeVar("_R")


class LaneMask(Protocol):
    """One bit per lane."""

    def __and__(self, other: LaneMask) -> LaneMask: ...


class Vector(Protocol):
    """`LANES` float32 values; operators work lane by lane, scalar operands are broadcast."""

    def __add__(self, other: VectorLike) -> Vector: ...
    def __radd__(self, other: VectorLike) -> Vector: ...
    def __sub__(self, other: VectorLike) -> Vector: ...
    def __rsub__(self, other: VectorLike) -> Vector: ...
    def __mul__(self, other: VectorLike) -> Vector: ...
    def __rmul__(self, other: VectorLike) -> Vector: ...
    def __truediv__(self, other: VectorLike) -> Vector: ...
    def __rtruediv__(self, other: VectorLike) -> Vector: ...
    def __neg__(self) -> Vector: ...
    def __lt__(self, other: VectorLike) -> LaneMask: ...
    def __le__(self, other: VectorLike) -> LaneMask: ...
    def __gt__(self, other: VectorLike) -> LaneMask: ...
    def __ge__(self, other: VectorLike) -> LaneMask: ...


VectorLike: TypeAlias = Vector | float | np.float32
Vectors: TypeAlias = tuple[Vector, ...]


class Intrinsic(NamedTuple, Generic[_R]):
    """Numba signature and code generator of a function that returns a value of static type R."""

    signature: Any
    emit: Callable[..., Any]


def typed_intrinsic(function: Callable[Concatenate[Any, _P], Intrinsic[_R]]) -> Callable[_P, _R]:
    """Register a function like `numba.extending.intrinsic`, but return it with its static type.

    The parameters after the typing context are annotated with the types of the values in a call; the function
    itself receives their Numba types.
    """
    registered: Any = intrinsic(function)  # numba types an intrinsic as a function that never returns
    return registered


def numba_signature(result: types.Type, *parameters: Any) -> Any:
    """Return a Numba signature; `parameters` are Numba types, whatever their static type."""
    return result(*parameters)
