"""Random valid messages of any class, generated from its fields, so that new classes are covered."""

from __future__ import annotations

import types
import typing
from typing import Any, Literal, get_args, get_origin

import annotated_types
import numpy as np
from pydantic import BaseModel, ValidationError
from scipy.spatial.transform import Rotation

from beamsplat.common.geometry.transforms import make_transform
from beamsplat.common.messages import Array


def random_message(cls: type[BaseModel], rng: np.random.Generator) -> Any:
    """Return a random valid instance of `cls`; draws again if dependent fields are inconsistent."""
    for _ in range(2000):
        sizes = {letter: int(rng.integers(0, 9)) for letter in "ABCDEFGHIJKLMNOPQRSTUVWXYZ"}
        if rng.random() < 0.5:
            sizes["M"] = sizes["N"]  # "none or one each" pairs are rare otherwise
        hints = typing.get_type_hints(cls, include_extras=True)
        fields = {
            name: _value(name, hints[name], field.metadata, sizes, rng)
            for name, field in cls.model_fields.items()
        }
        for name in {"fx_px", "fy_px"} & fields.keys():
            fields[name] = float(rng.uniform(0.1, 3.0)) * fields["width_px"]
        try:
            return cls(**fields)
        except ValidationError:
            continue
    raise AssertionError(f"no valid {cls.__name__} found")


def _value(name: str, hint: Any, metadata: list[Any], sizes: dict[str, int], rng: np.random.Generator) -> Any:
    if get_origin(hint) is typing.Annotated:
        hint, *more = get_args(hint)
        metadata = [*metadata, *more]
    array = next((entry for entry in metadata if isinstance(entry, Array)), None)
    if array is not None:
        return _array(name, array, sizes, rng)
    origin = get_origin(hint)
    if origin is Literal:
        return get_args(hint)[rng.integers(len(get_args(hint)))]
    if origin in (typing.Union, types.UnionType):
        options = [option for option in get_args(hint) if option is not type(None)]
        return None if rng.random() < 0.3 else _value(name, options[0], metadata, sizes, rng)
    if origin is tuple:
        parts = get_args(hint)
        if parts[-1] is Ellipsis:
            parts = [parts[0]] * int(rng.choice([0, 0, 4, 5, 8]))
        return tuple(_value(name, part, [], sizes, rng) for part in parts)
    if isinstance(hint, type) and issubclass(hint, BaseModel):
        return random_message(hint, rng)
    return _scalar(hint, metadata, rng)


def _array(name: str, array: Array, sizes: dict[str, int], rng: np.random.Generator) -> np.ndarray:
    shape = tuple(sizes[part] if isinstance(part, str) else part for part in array.shape)
    if shape[-2:] == (4, 4) and name.startswith("T_"):
        count = int(np.prod(shape[:-2]))
        made = [
            make_transform(Rotation.random(rng=rng).as_matrix(), rng.normal(0, 10, 3)) for _ in range(count)
        ]
        return np.array(made).reshape(shape)
    if array.dtype.kind == "f":
        values = rng.normal(0, 10, shape).astype(array.dtype)
        if not array.finite:
            values[rng.random(shape) < 0.1] = np.inf
            values[rng.random(shape) < 0.1] = np.nan
        return values
    if array.dtype.kind == "b":
        return rng.random(shape) < 0.5
    info = np.iinfo(array.dtype)
    return rng.integers(info.min, info.max, shape, array.dtype, endpoint=True)


def _scalar(hint: type, metadata: list[Any], rng: np.random.Generator) -> Any:
    low, high = _limits(metadata)
    if hint is bool:
        return bool(rng.random() < 0.5)
    if hint is int:
        low, high = int(low if low is not None else -(2**40)), int(high if high is not None else 2**40)
        width = rng.choice([4, 1000, 2**31, 2**62]) if high - low > 2**31 else high - low
        return int(rng.integers(low, min(high, low + int(width))))
    if hint is float:
        value = float(rng.normal(0, 10.0 ** rng.integers(-3, 4)))
        value = abs(value) + 1e-9 if low is not None and low >= 0.0 else value
        return float(np.clip(value, low, high))
    if hint is str:
        return "".join(
            chr(code) for code in rng.choice([*range(32, 127), 0xE4, 0x2603, 0x1F916], rng.integers(0, 20))
        )
    raise AssertionError(f"no random {hint}")


def _limits(metadata: list[Any]) -> tuple[float | None, float | None]:
    """Return the lower and upper bound in annotations, also inside pydantic's Field(...)."""
    low = high = None
    for entry in metadata:
        for bound in getattr(entry, "metadata", [entry]):
            if isinstance(bound, annotated_types.Ge):
                low = bound.ge
            elif isinstance(bound, annotated_types.Gt):
                low = bound.gt
            elif isinstance(bound, annotated_types.Le):
                high = bound.le
            elif isinstance(bound, annotated_types.Lt):
                high = bound.lt
    return low, high


def assert_same(a: Any, b: Any) -> None:
    """Assert bitwise equality: arrays by bytes, everything else by type and value."""
    assert type(a) is type(b), (type(a), type(b))
    if isinstance(a, BaseModel):
        for name in type(a).model_fields:
            assert_same(getattr(a, name), getattr(b, name))
    elif isinstance(a, np.ndarray):
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
    elif isinstance(a, tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b):
            assert_same(x, y)
    else:
        assert a == b
