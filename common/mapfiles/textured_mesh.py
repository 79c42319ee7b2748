"""A mesh with a texture as binary glTF (`.glb`): patches of the keyframes' images, packed into one picture.

The material is unlit (`KHR_materials_unlit`): the light is in the images. The rotation of the node converts z
up to y up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from beamsplat.common.files.persist import write_atomically
from beamsplat.common.mapfiles.gltf import FLOAT, glb
from beamsplat.common.mapfiles.mesh import TriangleMesh
from beamsplat.common.mapfiles.state import KeyframeView
from beamsplat.common.mapfiles.surface import RenderedDepth
from beamsplat.common.mapfiles.texture import ViewChoice, project
from beamsplat.common.mapfiles.y_up import QUAT_XYZW

MAX_TEXTURE_PX = 8192  # edge of the texture; WebGL 2 on phones takes 4096 to 16384
_PAD_PX = 2  # around each patch: filtering reads beyond its edge
_PLAIN_PX = 4  # edge of the squares of one colour, for triangles without a view
_LEVELS = 32  # of each channel of these colours
_SHRINK = 0.85  # factor on the patches, repeated until they fit
_JPEG_QUALITY = 92
_UNSIGNED = 5125


@dataclass(frozen=True)
class ImageOf:
    """The images of the views."""

    keyframes: list[KeyframeView]  # their cameras and poses
    read: Callable[[int], np.ndarray]  # returns image number i, uint8 [H, W, 3], with the map's exposure


@dataclass(frozen=True)
class _Atlas:
    """Rectangles in the texture: `at` int64 [R, 2] is (x, y) of each one's upper left pixel."""

    at: np.ndarray
    width_px: int
    height_px: int


def without_masked(view: RenderedDepth, mask: np.ndarray) -> RenderedDepth:
    """Return the view without depth (NaN), so without texture, where `mask` bool [H, W] is False."""
    height, width = view.depth_m.shape
    use = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA) > 0.99
    return replace(view, depth_m=np.where(use, view.depth_m, np.float32(np.nan)))


def write_textured_mesh(
    path: Path, mesh: TriangleMesh, choice: ViewChoice, images: ImageOf
) -> tuple[int, int]:
    """Write the mesh with its texture, atomically; return width and height of the texture (px).

    Raises:
        ValueError: the mesh has no triangles.
        OSError: the file cannot be written.
    """
    if len(mesh.faces) == 0:
        raise ValueError("the mesh has no triangles")
    seen = choice.patch >= 0
    count = int(choice.patch.max(initial=-1)) + 1
    view_of = np.zeros(count, np.int64)
    view_of[choice.patch[seen]] = choice.view[seen]
    pixels = _pixels(mesh, choice, images)
    low, high = _boxes(choice.patch[seen], pixels[seen], count)
    plain, which = _plain_colours(mesh, ~seen)
    scale = 1.0
    while (atlas := _pack(_sizes(low, high, scale), len(plain))) is None:
        scale *= _SHRINK
    texture = np.zeros((atlas.height_px, atlas.width_px, 3), np.uint8)
    sizes = _sizes(low, high, scale)
    for view in np.unique(view_of).tolist() if count else []:
        image = images.read(view)
        for patch in np.flatnonzero(view_of == view).tolist():
            (x, y), (w, h) = atlas.at[patch], sizes[patch]
            texture[y : y + h, x : x + w] = _cut(image, low[patch] - _PAD_PX / scale, scale, (w, h))
    uv = np.empty((len(mesh.faces), 3, 2))
    origin = atlas.at[choice.patch[seen]] + _PAD_PX - low[choice.patch[seen]] * scale
    uv[seen] = pixels[seen] * scale + origin[:, None]
    for number, colour in enumerate(plain):
        x, y = atlas.at[count + number]
        texture[y : y + _PLAIN_PX, x : x + _PLAIN_PX] = colour
    uv[~seen] = (atlas.at[count + which] + 0.5 * (_PLAIN_PX - 1))[:, None]
    uv = (uv + 0.5) / [atlas.width_px, atlas.height_px]  # our pixel centres have whole coordinates
    ok, jpeg = cv2.imencode(".jpg", texture[:, :, ::-1], (cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY))
    assert ok
    write_atomically(Path(path), _document(mesh, choice.patch, uv, jpeg.tobytes()))
    return atlas.width_px, atlas.height_px


def _pixels(mesh: TriangleMesh, choice: ViewChoice, images: ImageOf) -> np.ndarray:
    """Return the corners of each triangle in its image, float64 [M, 3, 2] px."""
    out = np.zeros((len(mesh.faces), 3, 2))
    for view in np.unique(choice.view[choice.view >= 0]).tolist():
        rows = choice.view == view
        corners = mesh.vertices_m[mesh.faces[rows]]
        out[rows] = project(corners, images.keyframes[view].camera, images.keyframes[view].T_map_camera)[
            ..., :2
        ]
    return out


def _boxes(patch: np.ndarray, pixels: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and largest pixel coordinates of each patch, float64 [count, 2] each."""
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    for corner in range(3):
        np.minimum.at(low, patch, pixels[:, corner])
        np.maximum.at(high, patch, pixels[:, corner])
    return np.floor(low), np.ceil(high)


def _sizes(low: np.ndarray, high: np.ndarray, scale: float) -> np.ndarray:
    return np.ceil((high - low) * scale).astype(int) + 1 + 2 * _PAD_PX


def _plain_colours(mesh: TriangleMesh, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct colours uint8 [C, 3] of triangles without a view, and the colour of each one."""
    mean = mesh.colours[mesh.faces[rows]].astype(float).mean(axis=1)
    step = 256 // _LEVELS
    rounded = np.minimum(np.floor(mean / step) * step + step / 2, 255).astype(np.uint8)
    if len(rounded) == 0:
        return np.zeros((0, 3), np.uint8), np.zeros(0, np.int64)
    plain, which = np.unique(rounded, axis=0, return_inverse=True)
    return plain, which.ravel()


def _pack(sizes: np.ndarray, squares: int) -> _Atlas | None:
    """Place rectangles (width, height) int64 [R, 2], then squares of one colour, on shelves.

    Returns None if they do not fit.
    """
    sizes = np.concatenate([sizes.reshape(-1, 2), np.full((squares, 2), _PLAIN_PX)])
    widest = int(sizes[:, 0].max())
    width = max(widest, int(np.ceil(np.sqrt(sizes.prod(axis=1).sum() * 1.1))))
    if width > MAX_TEXTURE_PX:
        return None
    at, x, y, shelf = np.zeros((len(sizes), 2), int), 0, 0, 0
    for number in np.argsort(-sizes[:, 1], kind="stable").tolist():  # the highest first
        w, h = sizes[number]
        if x + w > width:
            x, y, shelf = 0, y + shelf, 0
        at[number], shelf, x = (x, y), max(shelf, h), x + w
    height = y + shelf
    return None if height > MAX_TEXTURE_PX else _Atlas(at, width, height)


def _cut(image: np.ndarray, origin: np.ndarray, scale: float, size: tuple[int, int]) -> np.ndarray:
    """Return the part of an image that begins at pixel `origin`, scaled; beyond the border it is repeated."""
    # Averages over a pixel of the texture, where that is larger than one of the image.
    source = cv2.GaussianBlur(image, (0, 0), 0.4 / scale) if scale < 0.99 else image
    columns = (origin[0] + np.arange(size[0]) / scale).astype(np.float32)
    rows = (origin[1] + np.arange(size[1]) / scale).astype(np.float32)
    grid_x, grid_y = np.meshgrid(columns, rows)
    return cv2.remap(source, grid_x, grid_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _document(mesh: TriangleMesh, patch: np.ndarray, uv: np.ndarray, jpeg: bytes) -> bytes:
    """Return the glTF file; vertices are doubled where patches meet."""
    # A triangle without a view has vertices of its own.
    owner = np.where(patch >= 0, patch, patch.max(initial=-1) + 1 + np.arange(len(patch)))
    keys = np.stack([np.repeat(owner, 3), mesh.faces.ravel()], axis=1)
    _, first, index = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    positions = mesh.vertices_m[mesh.faces.ravel()[first]].astype("<f4")
    texcoords = uv.reshape(-1, 2)[first].astype("<f4")
    indices = index.ravel().astype("<u4")
    low, high = positions.min(axis=0).tolist(), positions.max(axis=0).tolist()
    document = {
        "extensionsUsed": ["KHR_materials_unlit"],
        "nodes": [{"name": "map, metres", "mesh": 0, "rotation": list(QUAT_XYZW)}],
        "meshes": [{"primitives": [
            {"mode": 4, "attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}
        ]}],
        "accessors": [
            {"bufferView": 0, "count": len(positions), "type": "VEC3", "componentType": FLOAT, "min": low,
             "max": high},
            {"bufferView": 1, "count": len(texcoords), "type": "VEC2", "componentType": FLOAT},
            {"bufferView": 2, "count": len(indices), "type": "SCALAR", "componentType": _UNSIGNED},
        ],
        "materials": [{
            "pbrMetallicRoughness": {
                "baseColorTexture": {"index": 0}, "metallicFactor": 0.0, "roughnessFactor": 1.0
            },
            "extensions": {"KHR_materials_unlit": {}},
        }],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [{"magFilter": 9729, "minFilter": 9729, "wrapS": 33071, "wrapT": 33071}],
        "images": [{"bufferView": 3, "mimeType": "image/jpeg"}],
    }  # fmt: skip
    return glb(document, [(positions, 34962), (texcoords, 34962), (indices, 34963), (jpeg, None)])
