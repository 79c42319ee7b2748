"""The mapper: keyframes with depth in, Gaussians out. Knows no clock, no messages and no torch.

Per keyframe: refuse what cannot be used, insert where the map does not explain the picture, carve what floats
before trusted surfaces, then a fixed number of steps on a window of new and randomly drawn old keyframes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from beamsplat.common.geometry.transforms import inverse, is_rigid
from beamsplat.common.mapfiles.store import Elsewhere, GaussianStore
from beamsplat.common.raster.layout import OPACITY
from beamsplat.common.raster.optimiser import rate_rows
from beamsplat.common.raster.rasterizer import Rasterizer, Render
from beamsplat.common.raster.ssim import SsimLoss
from beamsplat.services.mapping.insertion import foretold, new_gaussians, unexplained
from beamsplat.services.mapping.kernels import add_lidar, contradicted, photometric_and_depth
from beamsplat.services.mapping.keyframe import (
    Held,
    Keyframe,
    Level,
    hold,
    refine_exposure,
    refine_pose,
    with_hidden,
)
from beamsplat.services.mapping.places import Places
from beamsplat.services.mapping.settings import MapperSettings

FULL, HALF = 0, 1
_REMEMBERED = 4096  # keyframes given up whose ids are still known: robots keep fewer to send them again


@dataclass(frozen=True)
class Outcome:
    """What became of a keyframe. `status` is "ok" or one sentence: then the map is as it was."""

    status: str
    inserted: int = 0
    removed: int = 0
    foretold_share: float = 0.0  # of the pixels, covered by the map as it was
    foretold_psnr_db: float = float("nan")  # there, between the map as it was and the picture

    @property
    def ok(self) -> bool:
        return self.status == "ok"


class Mapper:
    """See module. The same keyframes and seed give the same map, bit for bit."""

    def __init__(self, settings: MapperSettings | None = None, *, seed: int = 0, threads: int = 1) -> None:
        self.settings = settings or MapperSettings()
        self.store = GaussianStore()
        self.elsewhere: Elsewhere | None = None  # where Gaussians are that are not in the store
        self.rasterizer = Rasterizer(threads)
        self.keyframes: dict[int, Held] = {}
        self.resting: dict[int, Held] = {}  # without their pictures, in order of their turn
        self.T_map_anchor: dict[int, np.ndarray] = {}
        self.steps = 0
        self._random = np.random.default_rng(seed)
        self._newest: list[int] = []
        self.given_up = 0  # keyframes, for the sake of others
        self.most_in_memory: int | None = None  # Gaussians: where a budget leaves no room, none are added
        self._forgotten: dict[int, None] = {}  # the last of them, in order
        self._places = Places()
        self._ssim = SsimLoss()
        self._buffers: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}
        r = self.settings.rates
        rest = (r.log_scale, r.quat, r.opacity_logit, r.colour)
        self._rates = rate_rows(r.mean_m, *rest)
        self._refining_rates = rate_rows(r.refined_mean_m, *rest)

    # --- keyframes and anchors ---------------------------------------------------------------------

    def add(
        self,
        frame: Keyframe,
        T_map_anchor: np.ndarray | None = None,
        bring: Callable[[Held], None] | None = None,
    ) -> Outcome:
        """Takes a keyframe in: insertion, carving, pruning. `optimise` is separate.

        `T_map_anchor` places the frame's anchor if it is new. A keyframe known by its id is left as it is.
        `bring` is called before anything changes: what the keyframe sees has to be in memory.
        """
        if self.knows(frame.id):
            return Outcome("ok")
        fault = frame.fault() or self._fault_of_place(frame, T_map_anchor)
        if fault is not None:
            return Outcome(fault)
        if frame.anchor not in self.T_map_anchor:
            self.T_map_anchor[frame.anchor] = np.array(T_map_anchor, dtype=np.float64)
        held = hold(frame, self.settings.sigma_unit)
        if bring is not None:
            bring(held)
        removed = self._clean(held)
        outcome = self._insert(held, held.levels[FULL])
        self._forget()
        self.keyframes[frame.id] = held
        self._places.put(held.id, self._T_map_given(held))
        self._newest = [*self._newest, frame.id][-self.settings.recent :]
        return replace(outcome, removed=removed)

    def holds(self, id: int) -> bool:
        """Whether a keyframe is in the map."""
        return id in self.keyframes or id in self.resting

    def knows(self, id: int) -> bool:
        """Whether a keyframe is in the map, or was and has been given up."""
        return self.holds(id) or id in self._forgotten

    def strike_off(self, id: int) -> None:
        """A keyframe that was resting does not come back."""
        self.resting.pop(id, None)
        self._places.remove(id)

    @property
    def newest(self) -> list[int]:
        """Ids of the window's newest keyframes, in order of coming."""
        return list(self._newest)

    @property
    def workspace_bytes(self) -> int:
        """What rendering and losses hold on to."""
        losses = sum(array.nbytes for pair in self._buffers.values() for array in pair)
        return self.rasterizer.held_bytes + self._ssim.held_bytes + losses

    def _forget(self) -> None:
        """Makes room for a keyframe: one of the place that has most goes; its Gaussians stay."""
        while len(self.keyframes) + len(self.resting) >= self.settings.max_keyframes:
            old = self._places.fullest(set(self._newest)) or sorted(self.keyframes)
            gone = old[int(self._random.integers(len(old)))]
            self.keyframes.pop(gone, None)
            self.resting.pop(gone, None)
            self._places.remove(gone)
            self._newest = [id for id in self._newest if id != gone]
            self.given_up += 1
            self._forgotten[gone] = None
            if len(self._forgotten) > _REMEMBERED:
                del self._forgotten[next(iter(self._forgotten))]

    def _T_map_given(self, held: Held) -> np.ndarray:
        """Where localization says the camera stood; the map's own corrections left out."""
        return self.T_map_anchor[held.anchor] @ held.T_anchor_camera

    def _sort_places(self) -> None:
        for held in (*self.keyframes.values(), *self.resting.values()):
            self._places.put(held.id, self._T_map_given(held))

    def _fault_of_place(self, frame: Keyframe, T_map_anchor: np.ndarray | None) -> str | None:
        if frame.anchor in self.T_map_anchor:
            return None
        if T_map_anchor is None or not is_rigid(T_map_anchor):
            return f"anchor {frame.anchor} has no place in the map"
        return None

    def T_map_camera(self, held: Held) -> np.ndarray:
        """T_map_anchor (SLAM) @ T_anchor_camera (SLAM) @ delta (mapper)."""
        return self.T_map_anchor[held.anchor] @ held.T_anchor_refined()

    def move_anchors(self, T_map_anchor: dict[int, np.ndarray]) -> int:
        """Takes new places of anchors: their Gaussians move along, exactly. Gives how many anchors moved.

        Raises:
            ValueError: a place is no rigid transform; then nothing has moved.
        """
        for anchor, T in T_map_anchor.items():
            if not is_rigid(T):
                raise ValueError(
                    f"anchor {anchor}: its new place is not a rigid transform: {np.asarray(T).tolist()}"
                )
        moved = 0
        for anchor, T in T_map_anchor.items():
            old = self.T_map_anchor.get(anchor)
            if old is not None and not np.allclose(old, T, atol=1e-9):
                self.store.move(anchor, T @ inverse(old))
                moved += 1
            self.T_map_anchor[anchor] = np.array(T, dtype=np.float64)
        if moved:
            self._sort_places()
        return moved

    def progress(self) -> dict[str, Any]:
        """What going on later needs beside Gaussians, keyframes and anchors; fit for JSON."""
        return {
            "steps": self.steps, "newest": list(self._newest), "forgotten": list(self._forgotten),
            "given_up": self.given_up, "random": self._random.bit_generator.state,
        }  # fmt: skip

    def resume(self, progress: dict[str, Any]) -> None:
        """Goes on from `progress`."""
        self.steps = progress["steps"]
        self._newest = [id for id in progress["newest"] if id in self.keyframes]
        self._forgotten = dict.fromkeys(progress["forgotten"])
        self.given_up = progress.get("given_up", len(self._forgotten))
        self._sort_places()
        self._random.bit_generator.state = progress["random"]

    # --- growing and shrinking ---------------------------------------------------------------------

    def _insert(self, held: Held, level: Level) -> Outcome:
        in_all, here = self.settings.max_gaussians - self.store.away_count, self.most_in_memory
        room = max(min(in_all, in_all if here is None else here) - self.store.count, 0)
        T_map_camera = self.T_map_camera(held)
        render = self._render(level, T_map_camera)
        missing = unexplained(render.image, level, self.settings)
        known = foretold(render.image, level)
        self.rasterizer.release(render)
        u, v, new = new_gaussians(missing, level, T_map_camera, self.settings)
        sure = level.depth_weight[v, u] >= 255.0 * self.settings.sure_weight
        new = new[:, sure | ~self._in_free_space(new)]
        new = new[:, :room]
        if new.shape[1]:
            self.store.add(new, held.anchor)
        return Outcome("ok", new.shape[1], 0, *known)

    def _in_free_space(self, params: np.ndarray) -> np.ndarray:
        """bool [N]: Gaussians float32 [14, N] that a recent keyframe sees through to a surface known well."""
        strikes = np.zeros(params.shape[1], np.int32)
        for id in self._newest:
            self._strike(self.keyframes[id], params, params.shape[1], strikes)
        return strikes > 0

    def _strike(self, held: Held, params: np.ndarray, count: int, strikes: np.ndarray) -> None:
        level, s = held.levels[HALF], self.settings
        packed = level.camera.packed(inverse(self.T_map_camera(held)))
        least = np.uint8(255.0 * s.carve_weight)
        contradicted(
            params, count, packed, level.depth_mm, level.depth_weight, least, s.carve_margin, strikes
        )

    def _clean(self, held: Held) -> int:
        """Drops what has faded, and what floats before surfaces that are known well; gives how many."""
        s, store = self.settings, self.store
        self._strike(held, store.params, store.count, store.strikes)
        faint = np.log(s.prune_opacity / (1.0 - s.prune_opacity))
        keep = (store.strikes[: store.count] < s.carve_strikes) & (
            store.params[OPACITY, : store.count] > faint
        )
        # Closing gaps moves all arrays: worth it only for many.
        return store.keep(keep) if np.count_nonzero(~keep) > store.count // 200 else 0

    # --- optimising --------------------------------------------------------------------------------

    def optimise(self, half: int | None = None, full: int | None = None) -> float:
        """The fixed work per keyframe: steps at half size, then at full size. Gives the mean loss."""
        half = self.settings.half_iterations if half is None else half
        full = self.settings.full_iterations if full is None else full
        if not self.keyframes or self.store.count == 0:
            return 0.0
        losses = [self.step(self._draw(), HALF) for _ in range(half)]
        losses += [self.step(self._draw(), FULL) for _ in range(full)]
        return float(np.mean(losses)) if losses else 0.0

    def refine(self, iterations: int, size: int = FULL) -> float:
        """Steps on all keyframes in random order, every one as often as the others. Gives the mean loss."""
        ids, losses = [], []
        for _ in range(iterations):
            if not ids:
                ids = list(self._random.permutation(sorted(self.keyframes)))
            losses.append(self.step(self.keyframes[int(ids.pop())], size, refining=True))
        return float(np.mean(losses)) if losses else 0.0

    def _draw(self) -> Held:
        """Half of the time one of the newest keyframes, else any."""
        pool = self._newest if self._random.random() < 0.5 else list(self.keyframes)
        return self.keyframes[pool[int(self._random.integers(len(pool)))]]

    def step(self, held: Held, size: int, *, refining: bool = False) -> float:
        """One render, loss, backward and Adam on one keyframe. Gives the loss."""
        level = held.levels[size]
        T_map_camera = self.T_map_camera(held)
        render = self._render(level, T_map_camera)
        if level.hidden is not None:
            level = with_hidden(level, render.image, held.exposure)
        loss, gradient, sums = self._loss(render, level, held)
        gradients = self.rasterizer.backward(render, gradient)
        s = self.settings
        pixels = level.camera.width_px * level.camera.height_px
        self.store.step(
            self.rasterizer.team, gradients, self._refining_rates if refining else self._rates,
            s.isotropy_weight / pixels, np.log(s.isotropy_ratio),
        )  # fmt: skip
        if s.refine_pose:
            refine_pose(
                held, gradients.pose, (s.rates.pose_m, s.rates.pose_rad), (s.max_pose_m, s.max_pose_rad)
            )
        if s.refine_exposure:
            refine_exposure(held, sums, s.rates.exposure)
        self.rasterizer.release(render)
        self.steps += 1
        return loss

    def _render(self, level: Level, T_map_camera: np.ndarray) -> Render:
        return self.rasterizer.render(
            self.store.params, self.store.count, level.camera, inverse(T_map_camera)
        )

    def _loss(self, render: Render, level: Level, held: Held) -> tuple[float, np.ndarray, np.ndarray]:
        s, (h, w) = self.settings, level.depth_mm.shape
        if (h, w) not in self._buffers:
            self._buffers[h, w] = np.empty((5, h, w), np.float32), np.empty((h, 8))
        gradient, sums = self._buffers[h, w]
        with_ssim = s.ssim_weight > 0.0 and self.steps % s.ssim_every == 0
        colour_scale = np.float32((1.0 - s.ssim_weight * with_ssim) / (3 * h * w))
        self.rasterizer.team.run(
            photometric_and_depth, render.image, level.rgb, level.depth_mm, level.depth_weight, held.exposure,
            colour_scale, np.float32(s.depth_weight / (h * w)), gradient, sums,
        )  # fmt: skip
        loss = float(sums[:, 0].sum() * colour_scale + sums[:, 1].sum())
        if len(level.beam_pixels):
            scale = np.float32(s.lidar_weight / len(level.beam_pixels))
            loss += add_lidar(render.image, level.beam_pixels, level.beam_z_m, scale, gradient)
        if with_ssim:
            loss += self._ssim.add(render.image, level.rgb, s.ssim_weight, gradient, self.rasterizer.team)
        if level.hidden is not None:
            gradient[:, level.hidden] = 0.0
        return loss, gradient, sums
