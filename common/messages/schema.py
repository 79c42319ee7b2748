"""Base classes and field types of messages: validated arrays and transforms, immutable models.

A message is a frozen pydantic model. Arrays are declared with dtype and shape,
`Annotated[np.ndarray, Array("float32", "N")]`; a dimension with the same letter must have the same size in
all fields of a message. Arrays are read-only because all subscribers in a process share the memory.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator
from pydantic_core import core_schema

from beamsplat.common.geometry.transforms import is_rigid

MAX_ARRAY_BYTES = 256 * 1024 * 1024
MAX_VELOCITY = 1e4  # m/s, rad/s: far above that of any robot
MAX_DISTANCE_M = 1e8  # of a translation: more than any coordinate on Earth, ECEF and UTM included


class Array:
    """Annotation of a NumPy field: dtype, shape, and whether NaN and infinity are rejected.

    Shape entries are ints (exact size) or letters (any size, the same within one message).
    """

    def __init__(self, dtype: str, *shape: int | str, finite: bool = False) -> None:
        self.dtype = np.dtype(dtype)
        self.shape = shape
        self.finite = finite

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> core_schema.CoreSchema:
        return core_schema.no_info_plain_validator_function(self.check)

    def check(self, value: Any) -> np.ndarray:
        """Validate an array and return a read-only, C-contiguous view (a copy if it is not contiguous).

        Raises:
            ValueError: the value is not an array, too large, not finite where required, or its dtype or shape
                differs.
        """
        if not isinstance(value, np.ndarray):
            raise ValueError(f"expected a numpy array, got {type(value).__name__}")
        if value.dtype != self.dtype:
            raise ValueError(f"expected dtype {self.dtype}, got {value.dtype}")
        if value.ndim != len(self.shape):
            raise ValueError(f"expected shape {list(self.shape)}, got {list(value.shape)}")
        for wanted, size in zip(self.shape, value.shape):
            if isinstance(wanted, int) and wanted != size:
                raise ValueError(f"expected shape {list(self.shape)}, got {list(value.shape)}")
        if value.nbytes > MAX_ARRAY_BYTES:
            raise ValueError(f"{value.nbytes} bytes exceed the limit of {MAX_ARRAY_BYTES}")
        if self.finite and not np.all(np.isfinite(value)):
            raise ValueError("contains NaN or infinity")
        view = np.ascontiguousarray(value).view()
        view.flags.writeable = False
        return view


def _check_rigid(T: np.ndarray) -> np.ndarray:
    if T.size and np.abs(T[..., :3, 3]).max() > MAX_DISTANCE_M:
        raise ValueError(f"has a translation of more than {MAX_DISTANCE_M:g} m")
    for matrix in T.reshape(-1, 4, 4):
        if not is_rigid(matrix):
            raise ValueError(f"is not a rigid transform: {matrix.tolist()}")
    return T


def _check_velocity(velocity: np.ndarray) -> np.ndarray:
    if np.abs(velocity).max() > MAX_VELOCITY:
        raise ValueError(f"a velocity of more than {MAX_VELOCITY:g} m/s or rad/s is impossible")
    return velocity


Transform = Annotated[np.ndarray, Array("float64", 4, 4, finite=True), AfterValidator(_check_rigid)]
Transforms = Annotated[np.ndarray, Array("float64", "N", 4, 4, finite=True), AfterValidator(_check_rigid)]
# Until the year 2116. The sum of a stamp and a duration then fits into int64.
StampNs = Annotated[int, Field(ge=0, lt=2**62)]
Velocity = Annotated[np.ndarray, Array("float64", 3, finite=True), AfterValidator(_check_velocity)]
Count = Annotated[int, Field(ge=0, lt=2**63)]
Name = Annotated[str, Field(max_length=256)]
Text = Annotated[str, Field(max_length=65536)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


class MessagePart(BaseModel):
    """Base class of structures within messages: immutable, strictly typed, no unknown fields."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, arbitrary_types_allowed=True)

    _lettered: ClassVar[tuple[tuple[str, int, str], ...]] = ()  # (field, axis, letter) of repeated letters

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Collect the dimensions that must agree once per class; they are checked for every message."""
        found = [
            (name, axis, letter)
            for name, field in cls.model_fields.items()
            for array in field.metadata
            if isinstance(array, Array)
            for axis, letter in enumerate(array.shape)
            if isinstance(letter, str)
        ]
        letters = [letter for _, _, letter in found]
        cls._lettered = tuple(entry for entry in found if letters.count(entry[2]) > 1)

    @model_validator(mode="after")
    def _dimensions_agree(self) -> MessagePart:
        sizes: dict[str, tuple[int, str]] = {}
        for name, axis, letter in self._lettered:
            size = getattr(self, name).shape[axis]
            known, first = sizes.setdefault(letter, (size, name))
            if known != size:
                raise ValueError(f"{name} has {letter}={size}, but {first} has {letter}={known}")
        return self


class Message(MessagePart):
    """Base class of all messages. `stamp_ns` is the measurement time, int64 nanoseconds.

    A message can keep its encoded payload (`codec.encode`), so that it is not encoded again to be queued,
    stored or forwarded. The payload is no field: it is neither compared nor copied by `model_copy`.
    """

    __slots__ = ("kept_payload",)

    version: ClassVar[str] = "1.0"
    oldest_major: ClassVar[int] = 0  # of the versions that `upgraded` can read; 0 = only that of `version`
    stamp_ns: StampNs

    @classmethod
    def schema_name(cls) -> str:
        return cls.__name__

    @classmethod
    def upgraded(cls, major: int, fields: dict[str, Any]) -> dict[str, Any]:
        """Return the fields of this version, made of the decoded `fields` of an older major version.

        A class with `oldest_major` overrides this.

        Raises:
            ValueError, TypeError: a field has a wrong type, or does not decode.
        """
        raise ValueError(f"{cls.schema_name()}: version {major} cannot be read")
