"""The mapper: keyframes with depth in, Gaussians out. Knows no clock, no messages and no torch.

Per keyframe: refuse what cannot be used, insert where the map does not explain the picture, carve what floats
before trusted surfaces, then a fixed number of steps on a window of new and randomly drawn old keyframes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from common.geometry import inverse, is_rigid, se3_exp, se3_log
from common.raster.layout import OPACITY
from common.raster.optimiser import rate_rows
from common.raster.rasterizer import Gradients, Rasterizer, Render
from services.mapping.insertion import new_gaussians, unexplained
from services.mapping.kernels import add_lidar, contradicted, photometric_and_depth
from services.mapping.keyframe import Held, Keyframe, Level, hold
from services.mapping.settings import MapperSettings
from services.mapping.ssim import SsimLoss
from services.mapping.store import GaussianStore

FULL, HALF = 0, 1


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
        self.rasterizer = Rasterizer(threads)
        self.keyframes: dict[int, Held] = {}
        self.T_map_anchor: dict[int, np.ndarray] = {}
        self.steps = 0
        self._random = np.random.default_rng(seed)
        self._newest: list[int] = []
        self._forgotten: set[int] = set()
        self._ssim = SsimLoss()
        self._buffers: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}
        r = self.settings.rates
        rest = (r.log_scale, r.quat, r.opacity_logit, r.colour)
        self._rates = rate_rows(r.mean_m, *rest)
        self._refining_rates = rate_rows(r.refined_mean_m, *rest)

    # --- keyframes and anchors ---------------------------------------------------------------------

    def add(self, frame: Keyframe, T_map_anchor: np.ndarray | None = None) -> Outcome:
        """Takes a keyframe in: insertion, carving, pruning. `optimise` is separate.

        `T_map_anchor` places the frame's anchor if it is new. A keyframe known by its id is left as it is.
        """
        if frame.id in self.keyframes or frame.id in self._forgotten:
            return Outcome("ok")
        fault = frame.fault() or self._fault_of_place(frame, T_map_anchor)
        if fault is not None:
            return Outcome(fault)
        if frame.anchor not in self.T_map_anchor:
            self.T_map_anchor[frame.anchor] = np.array(T_map_anchor, dtype=np.float64)
        held = hold(frame, self.settings.sigma_unit)
        removed = self._clean(held)
        outcome = self._insert(held, held.levels[FULL])
        self._forget()
        self.keyframes[frame.id] = held
        self._newest = [*self._newest, frame.id][-self.settings.recent :]
        return replace(outcome, removed=removed)

    def _forget(self) -> None:
        """Makes room for a keyframe: one drawn from all but the newest goes; its Gaussians stay."""
        while len(self.keyframes) >= self.settings.max_keyframes:
            old = [id for id in self.keyframes if id not in self._newest] or list(self.keyframes)
            gone = old[int(self._random.integers(len(old)))]
            del self.keyframes[gone]
            self._newest = [id for id in self._newest if id != gone]
            self._forgotten.add(gone)

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
        return moved

    def progress(self) -> dict[str, Any]:
        """What going on later needs beside Gaussians, keyframes and anchors; fit for JSON."""
        return {
            "steps": self.steps, "newest": list(self._newest), "forgotten": sorted(self._forgotten),
            "random": self._random.bit_generator.state,
        }  # fmt: skip

    def resume(self, progress: dict[str, Any]) -> None:
        """Goes on from `progress`."""
        self.steps = progress["steps"]
        self._newest = [id for id in progress["newest"] if id in self.keyframes]
        self._forgotten = set(progress["forgotten"])
        self._random.bit_generator.state = progress["random"]

    # --- growing and shrinking ---------------------------------------------------------------------

    def _insert(self, held: Held, level: Level) -> Outcome:
        room = max(self.settings.max_gaussians - self.store.count, 0)
        T_map_camera = self.T_map_camera(held)
        render = self._render(level, T_map_camera)
        missing = unexplained(render.image, level, self.settings)
        foretold = _foretold(render.image, level)
        self.rasterizer.release(render)
        u, v, new = new_gaussians(missing, level, T_map_camera, self.settings)
        sure = level.depth_weight[v, u] >= 255.0 * self.settings.sure_weight
        new = new[:, sure | ~self._in_free_space(new)]
        new = new[:, :room]
        if new.shape[1]:
            self.store.add(new, held.anchor)
        return Outcome("ok", new.shape[1], 0, *foretold)

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
            level = _with_hidden(level, render.image, held.exposure)
        loss, gradient, sums = self._loss(render, level, held)
        gradients = self.rasterizer.backward(render, gradient)
        s = self.settings
        pixels = level.camera.width_px * level.camera.height_px
        self.store.step(
            self.rasterizer.team, gradients, self._refining_rates if refining else self._rates,
            s.isotropy_weight / pixels, np.log(s.isotropy_ratio),
        )  # fmt: skip
        if s.refine_pose:
            self._refine_pose(held, gradients, inverse(T_map_camera))
        if s.refine_exposure:
            self._refine_exposure(held, sums)
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

    def _refine_pose(self, held: Held, gradients: Gradients, T_camera_map: np.ndarray) -> None:
        """Adam on the camera's own tangent: T_map_camera <- T_map_camera @ exp(-step)."""
        # T_camera_map <- exp(xi) T_camera_map moves T_map_camera on the right by exp(-xi).
        rates = np.repeat([self.settings.rates.pose_m, self.settings.rates.pose_rad], 3)
        held.pose_steps += 1
        move = _adam_step(gradients.pose, held.pose_first, held.pose_second, held.pose_steps) * rates
        tangent = se3_log(held.delta @ se3_exp(move))
        limits = np.repeat([self.settings.max_pose_m, self.settings.max_pose_rad], 3)
        held.delta = se3_exp(np.clip(tangent, -limits, limits))

    def _refine_exposure(self, held: Held, sums: np.ndarray) -> None:
        gradient = sums[:, 2:8].sum(axis=0) + 1e-3 * held.exposure  # a weak pull to "as it was taken"
        move = _adam_step(gradient, held.exposure_first, held.exposure_second, max(held.pose_steps, 1))
        held.exposure = (held.exposure - self.settings.rates.exposure * move).astype(np.float32)


def _foretold(image: np.ndarray, level: Level) -> tuple[float, float]:
    """Share of the pixels that the render float32 [5, H, W] covers, and its PSNR (dB) there."""
    covered = image[4] > 0.9
    if level.hidden is not None:
        covered &= ~level.hidden
    share = float(covered.mean())
    if share < 0.01:
        return share, float("nan")
    error = np.clip(image[:3, covered], 0.0, 1.0) - level.rgb[:, covered] * np.float32(1 / 255)
    return share, float(-10.0 * np.log10(max(float(np.mean(error**2)), 1e-12)))


def _with_hidden(level: Level, image: np.ndarray, exposure: np.ndarray) -> Level:
    """The level with hidden pixels as they are rendered: there is nothing to see, for SSIM's windows too."""
    gain, offset = np.exp(exposure[:3])[:, None, None], exposure[3:, None, None]
    shown = np.clip((image[:3] * gain + offset) * 255.0 + 0.5, 0.0, 255.0).astype(np.uint8)
    return replace(level, rgb=np.where(level.hidden, shown, level.rgb))


def _adam_step(gradient: np.ndarray, first: np.ndarray, second: np.ndarray, t: int) -> np.ndarray:
    """Adam's normalised step; updates the moments in place."""
    first += 0.1 * (gradient - first)
    second += 0.01 * (gradient**2 - second)
    return first / (1 - 0.9**t) / (np.sqrt(second / (1 - 0.99**t)) + 1e-12)
