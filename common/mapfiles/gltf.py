"""Gaussians as binary glTF with the extension `KHR_gaussian_splatting` (ratified).

Viewers without the extension show coloured points. Values are activated, as the extension requires: linear
scales (standard deviations, metres), opacity 0..1, unit quaternions xyzw, colour as the spherical harmonic of
degree 0. The rotation of the node converts z up to y up.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.common.files.persist import write_atomically
from beamsplat.common.mapfiles.ply import SH_C0
from beamsplat.common.mapfiles.y_up import QUAT_XYZW
from beamsplat.common.raster.layout import COLOUR, MEAN, OPACITY, QUAT, SCALE

_EXTENSION = "KHR_gaussian_splatting"
FLOAT, _SHORT = 5126, 5123  # component types
_VERTICES = 34962  # target of a buffer view
_WIDTH = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def write_gltf(path: Path, params: np.ndarray) -> None:
    """Write Gaussians float32 [14, N], in the map frame, as `.glb`, atomically.

    Raises:
        ValueError: there are no Gaussians; glTF has no empty arrays.
        OSError: the file cannot be written.
    """
    if params.shape[1] == 0:
        raise ValueError("the map has no Gaussians: a glTF file cannot be empty")
    colour = params[COLOUR : COLOUR + 3].T
    opacity = 1.0 / (1.0 + np.exp(-params[OPACITY].astype(np.float64)))
    w, x, y, z = params[QUAT : QUAT + 4] / np.linalg.norm(params[QUAT : QUAT + 4].astype(np.float64), axis=0)
    fallback = np.concatenate([_linear(np.clip(colour, 0.0, 1.0)), opacity[:, None]], axis=1)
    attributes: dict[str, np.ndarray] = {
        "POSITION": params[MEAN : MEAN + 3].T.astype("<f4"),
        "COLOR_0": np.round(fallback * 65535.0).astype("<u2"),
        f"{_EXTENSION}:ROTATION": np.stack([x, y, z, w], axis=1).astype("<f4"),
        f"{_EXTENSION}:SCALE": np.exp(params[SCALE : SCALE + 3].T).astype("<f4"),
        f"{_EXTENSION}:OPACITY": opacity[:, None].astype("<f4"),
        f"{_EXTENSION}:SH_DEGREE_0_COEF_0": ((colour - 0.5) / SH_C0).astype("<f4"),
    }
    write_atomically(Path(path), _splats(attributes))


def _linear(srgb: np.ndarray) -> np.ndarray:
    """Decode sRGB in [0, 1] to linear: the vertex colours of glTF are linear."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _splats(attributes: dict[str, np.ndarray]) -> bytes:
    accessors = []
    for number, array in enumerate(attributes.values()):
        accessor: dict[str, Any] = {
            "bufferView": number, "count": len(array), "type": _WIDTH[array.shape[1]],
            "componentType": _SHORT if array.dtype == np.uint16 else FLOAT,
        }  # fmt: skip
        if array.dtype == np.uint16:
            accessor["normalized"] = True
        accessors.append(accessor)
    positions = attributes["POSITION"]
    accessors[0] |= {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    primitive = {
        "mode": 0, "attributes": {name: number for number, name in enumerate(attributes)},
        "extensions": {_EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }  # fmt: skip
    document = {
        "extensionsUsed": [_EXTENSION],
        "nodes": [{"name": "map, metres", "mesh": 0, "rotation": list(QUAT_XYZW)}],
        "meshes": [{"primitives": [primitive]}], "accessors": accessors,
    }  # fmt: skip
    return glb(document, [(array, _VERTICES) for array in attributes.values()])


def glb(document: dict[str, Any], parts: list[tuple[np.ndarray | bytes, int | None]]) -> bytes:
    """Return a `.glb` file of one scene with node 0.

    Args:
        document: the rest of the JSON document; it refers to the parts as buffer views 0, 1, ...
        parts: content and target (34962 = vertices, 34963 = indices, None = neither) of each buffer view.
    """
    views, pieces, offset = [], [], 0
    for content, target in parts:
        blob = content if isinstance(content, bytes) else np.ascontiguousarray(content).tobytes()
        view = {"buffer": 0, "byteOffset": offset, "byteLength": len(blob)}
        views.append(view if target is None else view | {"target": target})
        pieces.append(blob + bytes(-len(blob) % 4))
        offset += len(pieces[-1])
    whole = {
        "asset": {"version": "2.0", "generator": "BeamSplat"}, "scene": 0, "scenes": [{"nodes": [0]}],
        **document, "bufferViews": views, "buffers": [{"byteLength": offset}],
    }  # fmt: skip
    head = json.dumps(whole, separators=(",", ":")).encode()
    head += b" " * (-len(head) % 4)
    total = 12 + 8 + len(head) + 8 + offset
    return b"".join((struct.pack("<4sII", b"glTF", 2, total), struct.pack("<I4s", len(head), b"JSON"), head,
                     struct.pack("<I4s", offset, b"BIN\0"), *pieces))  # fmt: skip
