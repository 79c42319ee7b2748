"""The CPU rasterizer on arrays: `render` an image, then `backward` from the gradient of a loss.

    rasterizer = Rasterizer(threads=2)
    render = rasterizer.render(params, count, camera, T_camera_map)     # params float32 [14, capacity]
    gradients = rasterizer.backward(render, dL_dimage)                  # dL_dimage float32 [5, H, W]
    rasterizer.release(render)

Each render uses a workspace from a pool until it is released, so several renders can exist at the same time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beamsplat.common.raster.bins import count_pairs, prefix_sum, scatter
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.culling import BLOCK, compact, cull
from beamsplat.common.raster.layout import BATCHES, CHANNELS, GRADIENTS, PARAMS, RECORD, SLOT, TILE_H, TILE_W
from beamsplat.common.raster.project import project_and_emit
from beamsplat.common.raster.project_backward import project_backward
from beamsplat.common.raster.simd import LANES
from beamsplat.common.raster.threads import ThreadTeam
from beamsplat.common.raster.tiles import backward_tiles, forward_tiles


class Workspace:
    """Memory for the arrays of one render, reused by later renders.

    Arrays grow when needed and never shrink: page faults of newly allocated memory take longer than the
    rendering itself.
    """

    def __init__(self) -> None:
        self._arrays: dict[str, np.ndarray] = {}

    def take(self, name: str, shape: tuple[int, ...], dtype: type = np.float32) -> np.ndarray:
        """Return the array `name` with this shape and dtype, C-contiguous; its content is undefined.

        It uses the same memory as the array that an earlier call returned for this name.
        """
        size = int(np.prod(shape))
        held = self._arrays.get(name)
        if held is None or held.size < size or held.dtype != dtype:
            held = _aligned(size + size // 4, dtype)
            self._arrays[name] = held
        return held[:size].reshape(shape)

    @property
    def allocated_bytes(self) -> int:
        return sum(array.nbytes for array in self._arrays.values())


def _aligned(size: int, dtype: type) -> np.ndarray:
    """Return an uninitialised array [size] that is aligned to a cache line (64 bytes)."""
    item = np.dtype(dtype).itemsize
    raw = np.empty(size * item + 64, np.uint8)
    skip = -raw.ctypes.data % 64
    return raw[skip : skip + size * item].view(dtype)


@dataclass(frozen=True)
class TileLists:
    """Projected splats and their lists per tile; V = visible Gaussians. The memory belongs to a workspace."""

    index: np.ndarray  # int32 [>= V]: Gaussian of each visible splat, ascending
    records: np.ndarray  # float32 [V * RECORD]: splats projected to the image
    first_pair: np.ndarray  # int32 [V]: first (splat, tile) pair of each splat
    pair_count: np.ndarray  # int32 [V]: number of its pairs
    list_row: np.ndarray  # int32: row in `lists` of each pair
    lists: np.ndarray  # int32 [pairs + 1, 2]: (splat, rows) tile by tile, nearest first in each tile
    tile_start: np.ndarray  # int64 [tiles + 1]: first row in `lists` of each tile


@dataclass
class Render:
    """A rendered image, with the data that `Rasterizer.backward` needs.

    The arrays are valid until `Rasterizer.release`.
    """

    image: np.ndarray  # float32 [5, H, W]: red, green, blue, accumulated depth (m), alpha
    index: np.ndarray  # int32 [V]: Gaussians in the view frustum, ascending
    params: np.ndarray
    camera: np.ndarray
    background: np.ndarray
    workspace: Workspace
    tables: TileLists

    @property
    def pairs(self) -> int:
        """Number of (splat, tile) pairs: each splat counts once per tile that it overlaps."""
        return len(self.tables.lists) - 1

    def expected_depth(self) -> np.ndarray:
        """Return `expected_depth` of the image."""
        return expected_depth(self.image)


def expected_depth(image: np.ndarray) -> np.ndarray:
    """Return the expected depth float32 [H, W] (m) of a render [5, H, W]; NaN where alpha is <= 1e-3."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(image[4] > 1e-3, image[3] / image[4], np.float32(np.nan))


@dataclass
class Gradients:
    """Gradients of a loss L with respect to the parameters of the visible Gaussians and the camera pose.

    `by_splat` is memory of the render and valid until `Rasterizer.release`.
    """

    by_splat: np.ndarray  # float32 [GRADIENTS, >= V]: rows as in layout, one column per visible Gaussian
    index: np.ndarray  # int32 [V]: Gaussian of each column, ascending
    pose: np.ndarray  # float64 [6]: (rho, phi), left perturbation of T_camera_map

    def dense(self, count: int) -> np.ndarray:
        """Return the gradients of all Gaussians, float32 [GRADIENTS, count]: zero for invisible ones."""
        out = np.zeros((GRADIENTS, count), np.float32)
        out[:, self.index] = self.by_splat[:, : len(self.index)]
        return out


class Rasterizer:
    """Differentiable CPU rasterizer with its threads and its pool of workspaces."""

    def __init__(self, threads: int = 1) -> None:
        self.team = ThreadTeam(threads)
        self._pool: list[Workspace] = []
        self._capacity = 4096  # (splat, tile) pairs per batch of splats; grows as scenes need it

    def render(
        self,
        params: np.ndarray,  # float32 [14, capacity], C-contiguous, capacity a multiple of 16
        count: int,  # Gaussians in use, <= capacity
        camera: RasterCamera,
        T_camera_map: np.ndarray,
        background: np.ndarray | None = None,  # float32 [3], default black
    ) -> Render:
        """Render the first `count` Gaussians of `params`.

        Args:
            params: float32 [PARAMS, capacity], rows as in `raster.layout`, means in the map frame.
            count: number of columns in use.
            camera: intrinsics and image size.
            T_camera_map: pose, [4, 4].
            background: RGB in [0, 1], [3]; default black.

        Returns:
            The render; its `image` is float32 [5, H, W]: red, green, blue, accumulated depth (m), alpha.

        Raises:
            ValueError: an array has another shape or dtype, or the pose is not finite.
        """
        stride = _check_params(params, count)
        packed = camera.packed(T_camera_map)
        background = np.zeros(3, np.float32) if background is None else np.asarray(background, np.float32)
        if background.shape != (3,):
            raise ValueError(f"background must be 3 colours, got shape {list(background.shape)}")
        work = self._pool.pop() if self._pool else Workspace()
        flat = params.reshape(-1)
        seen = self._visible(work, flat, stride, count, packed)
        tables = self._bin(work, flat, stride, seen, packed, camera)
        image = work.take("image", (CHANNELS, camera.height_px, camera.width_px))
        tiles_x = -(-camera.width_px // TILE_W)
        self.team.run(
            forward_tiles, tiles_x, background, tables.lists, tables.tile_start, tables.records, image
        )
        return Render(image, seen[0][: seen[2]], params, packed, background, work, tables)

    def backward(self, render: Render, gradient: np.ndarray) -> Gradients:
        """Return the gradients of a loss L with respect to Gaussians and camera pose.

        Can be called several times on one render; each call overwrites `by_splat` of the previous result.

        Args:
            render: result of `render`, not released.
            gradient: dL/d(image), float32 [5, H, W], channels as in `Render.image`.
        """
        if gradient.shape != render.image.shape or gradient.dtype != np.float32:
            raise ValueError(
                f"the gradient must be float32 {list(render.image.shape)}, "
                f"got {gradient.dtype} {list(gradient.shape)}"
            )
        work, tables, visible = render.workspace, render.tables, len(render.index)
        slots = work.take("slots", (max(render.pairs, 1) * SLOT,))
        tiles_x = -(-render.image.shape[2] // TILE_W)
        self.team.run(
            backward_tiles, tiles_x, render.background, tables.lists, tables.tile_start, tables.records,
            render.image, gradient, slots,
        )  # fmt: skip
        out = work.take("gradients", (GRADIENTS, -(-max(visible, 1) // LANES) * LANES))
        pose_sums = np.zeros((BATCHES, 6))
        self.team.run(
            project_backward, render.params.reshape(-1), render.params.shape[1], tables.index, visible,
            render.camera, slots, tables.list_row, tables.first_pair, tables.pair_count, out, pose_sums,
        )  # fmt: skip
        return Gradients(out, render.index, pose_sums.sum(axis=0))

    def release(self, render: Render) -> None:
        """Return the memory of a render to the pool; the arrays of `render` must not be used any more."""
        self._pool.append(render.workspace)

    @property
    def allocated_bytes(self) -> int:
        """Memory (bytes) of the workspaces in the pool; workspaces of unreleased renders are not counted."""
        return sum(work.allocated_bytes for work in self._pool)

    def close(self) -> None:
        """Stop the threads."""
        self.team.close()

    def _visible(
        self, work: Workspace, flat: np.ndarray, stride: int, count: int, packed: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, int]:
        room = count + 2 * LANES
        index, depth = work.take("index", (room,), np.int32), work.take("depth", (room,))
        kept = work.take("kept", (-(-count // BLOCK),), np.int64)
        self.team.run(cull, flat, stride, count, packed, index, depth, kept)
        return index, depth, int(compact(index, depth, kept))

    def _bin(
        self, work: Workspace, flat: np.ndarray, stride: int, seen: tuple[np.ndarray, np.ndarray, int],
        packed: np.ndarray, camera: RasterCamera,
    ) -> TileLists:  # fmt: skip
        index, depth, visible = seen
        width, height = camera.width_px, camera.height_px
        tiles_x, tiles_y = -(-width // TILE_W), -(-height // TILE_H)
        records = work.take("records", ((visible + LANES) * RECORD,))
        first_pair = work.take("first_pair", (visible,), np.int32)
        pair_count = work.take("pair_count", (visible,), np.int32)
        order, order_other = (work.take(name, (visible,), np.int32) for name in ("order", "order_other"))
        keys, keys_other = (work.take(name, (visible,), np.uint32) for name in ("keys", "keys_other"))
        emitted = np.zeros(BATCHES, np.int64)
        while True:
            tiles = work.take("tiles", (BATCHES * self._capacity + 64,), np.int32)
            rows = work.take("rows", (BATCHES * self._capacity,), np.int32)
            self.team.run(
                project_and_emit, flat, stride, index, visible, packed, width, height, tiles_x,
                records, first_pair, pair_count, tiles, rows, emitted,
                depth, order, keys, keys_other, order_other,
            )  # fmt: skip
            most = int(emitted.max())
            if most <= self._capacity:
                break
            self._capacity = most + most // 2
        per_tile = work.take("per_tile", (BATCHES, tiles_x * tiles_y), np.int32)
        tile_start = work.take("tile_start", (tiles_x * tiles_y + 1,), np.int64)
        self.team.run(count_pairs, visible, order, first_pair, pair_count, tiles, per_tile)
        lists = work.take("lists", (int(prefix_sum(per_tile, tile_start)) + 1, 2), np.int32)
        self.team.run(scatter, visible, order, first_pair, pair_count, tiles, rows, per_tile, lists)
        return TileLists(index, records, first_pair, pair_count, tiles, lists, tile_start)


def _check_params(params: np.ndarray, count: int) -> int:
    if (
        params.dtype != np.float32
        or params.ndim != 2
        or params.shape[0] != PARAMS
        or not params.flags.c_contiguous
    ):
        raise ValueError(
            f"parameters must be contiguous float32 [{PARAMS}, capacity], got {params.dtype} {params.shape}"
        )
    if params.shape[1] % 16 or not 0 <= count <= params.shape[1]:
        raise ValueError(f"capacity {params.shape[1]} must be a multiple of 16 and hold {count} Gaussians")
    return params.shape[1]
