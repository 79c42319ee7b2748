"""Text of the kernels, and what Python must know of them: argument structures and threads per block.

The constants come from `layout.py`, so that all rasterizers have the same ones.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from beamsplat.common.harmonics.basis import C1, C2, C3
from beamsplat.common.raster import layout, optimiser, ssim

FILES = ("arguments", "project", "raster", "chain", "harmonics", "losses", "mapping")
BUCKET = (
    32  # pairs of one warp of the backward pass; the forward pass keeps the pixel states before each bucket
)
GROUP = 128  # pairs of one block of the backward pass
BLOCK = 256  # threads of a block, one Gaussian or one pixel each
EMPTY_TILE = 32767  # the largest int16: behind all tiles
KEYFRAME_STATE = 48  # float64 values of a keyframe, see `keyframe_states`
TILES = (8, 16)  # possible sides of a tile, px

_TYPES: dict[str, Any] = {"int": ctypes.c_int, "float": ctypes.c_float, "double": ctypes.c_double}
_STRUCTURE = re.compile(r"^struct (?P<name>\w+Arguments) \{(?P<body>.*?)^\};", re.MULTILINE | re.DOTALL)
_DECLARATION = re.compile(
    r"^\s*(?:const )?(?P<type>(?:unsigned |long )?\w+) (?P<names>[^;/]+);", re.MULTILINE
)
_NAME = re.compile(r"(?P<pointer>\*?)(?P<name>\w+)(?:\[(?P<length>\d+)\])?")
_KERNEL = re.compile(r"^KERNEL\((?P<threads>\w+)\) (?P<name>\w+)\((?P<arguments>\w+) s\)", re.MULTILINE)


@dataclass(frozen=True)
class KernelSource:
    """The program for one size of tiles.

    Attributes:
        tile: side of a tile, px.
        text: CUDA C++, without the definition of the macro `KERNEL(threads)` that begins each kernel.
        structures: ctypes structure of each argument type.
        kernels: for each kernel, the name of its argument type and its number of threads per block.
    """

    tile: int
    text: str
    structures: dict[str, type[ctypes.Structure]]
    kernels: dict[str, tuple[str, int]]

    @property
    def revision(self) -> str:
        """Return a digest of the text, 12 hexadecimal digits."""
        return hashlib.sha256(self.text.encode()).hexdigest()[:12]


class Kernels(Protocol):
    """Compiled kernels on a device: the GPU, or in tests the CPU."""

    device: torch.device
    source: KernelSource
    description: str  # device, compiler and version: what the results' bits depend on

    def launch(self, name: str, blocks: int, arguments: ctypes.Structure) -> None:
        """Start a kernel on torch's current stream, without waiting for it."""


@functools.cache
def kernel_source(tile: int = 8) -> KernelSource:
    """Return the program for tiles of `tile` x `tile` pixels.

    Raises:
        ValueError: there is no program for this size.
    """
    if tile not in TILES:
        raise ValueError(f"tiles have {' or '.join(map(str, TILES))} px, not {tile}")
    constants = _constants(tile)
    folder = Path(__file__).parent
    parts = [(folder / f"{name}.cu").read_text() for name in FILES]
    defines = "".join(f"#define {name} {_literal(value)}\n" for name, value in constants.items())
    text = defines + "\n".join(parts)
    structures = {m["name"]: _structure(m["name"], m["body"]) for m in _STRUCTURE.finditer(parts[0])}
    kernels = {
        m["name"]: (m["arguments"], int(constants.get(m["threads"], 0)) or int(m["threads"]))
        for m in _KERNEL.finditer(text)
    }
    return KernelSource(tile, text, structures, kernels)


def _constants(tile: int) -> dict[str, float]:
    names = (
        "SCALE", "QUAT", "OPACITY", "COLOUR", "PARAMS", "SCREEN_GRADIENT", "WEIGHT", "GRADIENTS", "CHANNELS",
        "BLUR_PX2", "ALPHA_MAX", "MIN_TRANSMITTANCE", "LOG2_ALPHA_MIN",
    )  # fmt: skip
    return {
        **{name: getattr(layout, name) for name in names},
        "TILE": tile, "TILE_SHIFT": tile.bit_length() - 1, "PIXELS": tile * tile,
        "BUCKET": BUCKET, "GROUP": GROUP, "EMPTY_TILE": EMPTY_TILE, "KEYFRAME_STATE": KEYFRAME_STATE,
        "FAR": 3.0e38, "LOG2_E": math.log2(math.e),
        "ADAM_1": 1.0 - optimiser.BETA_1, "ADAM_2": 1.0 - optimiser.BETA_2, "EPSILON": optimiser.EPSILON,
        "LN_BETA_1": math.log(optimiser.BETA_1), "LN_BETA_2": math.log(optimiser.BETA_2),
        "SSIM_C1": ssim.C1, "SSIM_C2": ssim.C2,
        "SH_1": C1, **{f"SH_2{k}": value for k, value in enumerate(C2)},
        **{f"SH_3{k}": value for k, value in enumerate(C3)},
        **{f"LUMA_{channel}": float(weight) for channel, weight in zip("RGB", ssim.LUMA)},
    }  # fmt: skip


def _literal(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value!r}f"


def _structure(name: str, body: str) -> type[ctypes.Structure]:
    """Build the ctypes structure of a C structure; pointers become `c_void_p`."""
    fields: list[tuple[str, Any]] = []
    for line in _DECLARATION.finditer(body):
        for part in line["names"].split(","):
            found = _NAME.fullmatch(part.strip())
            if found is None:
                raise ValueError(f"{name}: cannot read the declaration {line[0].strip()!r}")
            kind: Any = ctypes.c_void_p if found["pointer"] else _TYPES[line["type"]]
            fields.append((found["name"], kind * int(found["length"]) if found["length"] else kind))
    structure: Any = type(name, (ctypes.Structure,), {"_fields_": fields})
    return structure


def filled(structure: type[ctypes.Structure], **values: Any) -> ctypes.Structure:
    """Return a structure with fields from tensors (their addresses), arrays of numbers, numbers and None."""
    out, kinds = structure(), {field[0]: field[1] for field in structure._fields_}
    for name, value in values.items():
        kind: Any = kinds[name]
        if kind is ctypes.c_void_p:
            if value is not None and not value.is_contiguous():
                raise ValueError(f"{name} must be contiguous")
            setattr(out, name, None if value is None else value.data_ptr())
        elif hasattr(kind, "_length_"):
            setattr(out, name, kind(*np.asarray(value).ravel().tolist()))
        else:
            setattr(out, name, int(value) if kind is ctypes.c_int else float(value))
    return out
