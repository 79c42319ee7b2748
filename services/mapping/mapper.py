"""The mapper: RGB-D keyframes in, Gaussians out. Independent of clock, messages and torch.

Per keyframe: reject invalid input; remove Gaussians that float in front of trusted surfaces (carving); insert
Gaussians where the map does not explain the image; then optimise a fixed number of steps on a window of new
and randomly drawn old keyframes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count, repeat
from typing import Any

import numpy as np

from beamsplat.common.geometry.transforms import inverse, is_rigid
from beamsplat.common.mapfiles.store import DiskGaussians, GaussianStore
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.services.mapping.engines.cpu import CpuEngine, count_votes
from beamsplat.services.mapping.engines.protocol import Engine, OptimiserStep
from beamsplat.services.mapping.insertion import new_gaussians, prediction_quality, unexplained_pixels
from beamsplat.services.mapping.keyframe import PyramidLevel, RgbdKeyframe, StoredKeyframe, compress
from beamsplat.services.mapping.pose_bins import PoseBins
from beamsplat.services.mapping.settings import MapperSettings
from beamsplat.services.mapping.step_plan import StepPlan

FULL, HALF = 0, 1  # indices of StoredKeyframe.levels
_MAX_DROPPED_IDS = 4096  # ids of dropped keyframes remembered; a robot's queue holds fewer to send again


@dataclass(frozen=True)
class InsertionResult:
    """The result of inserting a keyframe: numbers of Gaussians, and the prediction by the map before.

    `status` is "ok", or the reason why the keyframe was rejected and the map did not change.
    """

    status: str
    inserted: int = 0
    removed: int = 0
    predicted_coverage: float = 0.0  # fraction of the pixels covered by the map before the insertion
    predicted_psnr_db: float = float("nan")  # of these pixels: the map before the insertion against the image

    @property
    def ok(self) -> bool:
        return self.status == "ok"


class Mapper:
    """The map and its optimiser. The same keyframes, seed and engine produce a bit-identical map.

    It decides what is computed; an engine (services/mapping/engines) computes it.
    """

    def __init__(
        self,
        settings: MapperSettings | None = None,
        *,
        seed: int = 0,
        threads: int = 1,
        engine: Engine | None = None,
    ) -> None:
        """Args:
        threads: of the CPU engine.
        engine: None = the CPU engine.
        """
        self.settings = settings or MapperSettings()
        self.engine: Engine = CpuEngine(threads) if engine is None else engine
        self.disk_gaussians: DiskGaussians | None = None  # Gaussians that are not in `store`
        self.keyframes: dict[int, StoredKeyframe] = {}
        self.paged_out: dict[int, StoredKeyframe] = {}  # without images; the first is paged in next
        self.T_map_anchor: dict[int, np.ndarray] = {}
        self.pose_revision = 0  # number of moves of anchors in this process
        self.steps = 0  # of the optimiser, in all
        self.plan = StepPlan()  # steps that are owed
        self.must_stop: Callable[[], bool] = lambda: False  # asked between two steps: ends them early
        self._random = np.random.default_rng(seed)
        self._newest: list[int] = []
        self.dropped_count = 0  # keyframes dropped to respect max_keyframes
        self.max_in_memory: int | None = None  # limit on Gaussians in memory, set by the pager
        self._dropped: dict[int, None] = {}  # ids of the latest ones, oldest first
        self._bins = PoseBins()

    @property
    def store(self) -> GaussianStore:
        """Return the Gaussians in memory."""
        return self.engine.store

    def render(self, camera: RasterCamera, T_map_camera: np.ndarray) -> np.ndarray:
        """Return the map in memory as float32 [5, H, W]: red, green, blue, accumulated depth (m), alpha."""
        return self.engine.render(camera, inverse(T_map_camera))

    # --- keyframes and anchors ---------------------------------------------------------------------

    def add(
        self,
        frame: RgbdKeyframe,
        T_map_anchor: np.ndarray | None = None,
        load_visible: Callable[[StoredKeyframe], None] | None = None,
    ) -> InsertionResult:
        """Insert a keyframe: remove floating and faint Gaussians, add new ones. Call `optimise` afterwards.

        Args:
            T_map_anchor: pose of the keyframe's anchor; used only if the anchor is new.
            load_visible: called before the map changes; pages in the Gaussians that the keyframe observes.

        Returns:
            The result; "ok" without any effect if a keyframe with this id was inserted before.
        """
        if self.was_inserted(frame.id):
            return InsertionResult("ok")
        fault = frame.fault() or self._anchor_fault(frame, T_map_anchor)
        if fault is not None:
            return InsertionResult(fault)
        if frame.anchor not in self.T_map_anchor:
            self.T_map_anchor[frame.anchor] = np.array(T_map_anchor, dtype=np.float64)
        keyframe = compress(frame, self.settings.sigma_unit)
        if load_visible is not None:
            load_visible(keyframe)
        removed = self._prune(keyframe)
        outcome = self._insert(keyframe, keyframe.levels[FULL])
        self._drop_redundant()
        self.keyframes[frame.id] = keyframe
        self._bins.insert(keyframe.id, self._T_map_camera_slam(keyframe))
        self._newest = [*self._newest, frame.id][-self.settings.recent :]
        return replace(outcome, removed=removed)

    def contains(self, id: int) -> bool:
        """Return whether a keyframe is in the map."""
        return id in self.keyframes or id in self.paged_out

    def was_inserted(self, id: int) -> bool:
        """Return whether a keyframe is in the map, or was in the map and has been dropped."""
        return self.contains(id) or id in self._dropped

    def forget(self, id: int) -> None:
        """Remove a paged-out keyframe whose file cannot be read."""
        self.paged_out.pop(id, None)
        self._bins.remove(id)

    @property
    def newest(self) -> list[int]:
        """Return the ids of the newest keyframes, in order of arrival."""
        return list(self._newest)

    @property
    def workspace_bytes(self) -> int:
        """Return the size of the buffers for rendering and losses in host memory, in bytes."""
        return self.engine.workspace_bytes

    def _drop_redundant(self) -> None:
        """Drop random keyframes of the fullest pose bin until one more fits; their Gaussians stay."""
        while len(self.keyframes) + len(self.paged_out) >= self.settings.max_keyframes:
            old = self._bins.fullest(set(self._newest)) or sorted(self.keyframes)
            gone = old[int(self._random.integers(len(old)))]
            self.keyframes.pop(gone, None)
            self.paged_out.pop(gone, None)
            self.engine.forget(gone)
            self._bins.remove(gone)
            self._newest = [id for id in self._newest if id != gone]
            self.dropped_count += 1
            self._dropped[gone] = None
            if len(self._dropped) > _MAX_DROPPED_IDS:
                del self._dropped[next(iter(self._dropped))]

    def _T_map_camera_slam(self, keyframe: StoredKeyframe) -> np.ndarray:
        """Return the camera pose as SLAM estimated it, without the mapper's correction."""
        return self.T_map_anchor[keyframe.anchor] @ keyframe.T_anchor_camera

    def _update_bins(self) -> None:
        for keyframe in (*self.keyframes.values(), *self.paged_out.values()):
            self._bins.insert(keyframe.id, self._T_map_camera_slam(keyframe))

    def _anchor_fault(self, frame: RgbdKeyframe, T_map_anchor: np.ndarray | None) -> str | None:
        if frame.anchor in self.T_map_anchor:
            return None
        if T_map_anchor is None or not is_rigid(T_map_anchor):
            return f"the pose of anchor {frame.anchor} is unknown"
        return None

    def T_map_camera(self, keyframe: StoredKeyframe) -> np.ndarray:
        """Return T_map_anchor (SLAM) @ T_anchor_camera (SLAM) @ delta (mapper)."""
        return self.T_map_anchor[keyframe.anchor] @ keyframe.T_anchor_refined()

    def move_anchors(self, T_map_anchor: dict[int, np.ndarray]) -> int:
        """Set new poses of anchors (float64 [4, 4]) and move the Gaussians rigidly with their anchors.

        Returns:
            The number of known anchors whose pose has changed.

        Raises:
            ValueError: a pose is not a rigid transform; then nothing has changed.
        """
        for anchor, T in T_map_anchor.items():
            if not is_rigid(T):
                raise ValueError(
                    f"anchor {anchor}: the new pose is not a rigid transform: {np.asarray(T).tolist()}"
                )
        moved = 0
        for anchor, T in T_map_anchor.items():
            old = self.T_map_anchor.get(anchor)
            if old is not None and not np.allclose(old, T, atol=1e-9):
                self.store.move(anchor, T @ inverse(old))
                moved += 1
            self.T_map_anchor[anchor] = np.array(T, dtype=np.float64)
        if moved:
            self.pose_revision += 1
            self._update_bins()
        return moved

    def progress(self) -> dict[str, Any]:
        """Return the counters and the random state that `resume` needs, as JSON values."""
        return {
            "steps": self.steps, "newest": list(self._newest), "forgotten": list(self._dropped),
            "given_up": self.dropped_count, "random": self._random.bit_generator.state,
            "owed": self.plan.progress(),
        }  # fmt: skip

    def resume(self, progress: dict[str, Any]) -> None:
        """Restore the counters and the random state that `progress` returned."""
        self.steps = progress["steps"]
        self.plan.resume(progress.get("owed", []))
        self._newest = [id for id in progress["newest"] if id in self.keyframes]
        self._dropped = dict.fromkeys(progress["forgotten"])
        self.dropped_count = progress.get("given_up", len(self._dropped))
        self._update_bins()
        self._random.bit_generator.state = progress["random"]

    # --- insertion and pruning ---------------------------------------------------------------------

    def _insert(self, keyframe: StoredKeyframe, level: PyramidLevel) -> InsertionResult:
        """Insert Gaussians where the map does not explain the keyframe, within the limits on their number."""
        in_all, here = self.settings.max_gaussians - self.store.paged_out_count, self.max_in_memory
        room = max(min(in_all, in_all if here is None else here) - self.store.count, 0)
        T_map_camera = self.T_map_camera(keyframe)
        image = self.render(level.camera, T_map_camera)
        missing = unexplained_pixels(image, level, self.settings)
        known = prediction_quality(image, level)
        u, v, new = new_gaussians(missing, level, T_map_camera, self.settings)
        sure = level.depth_weight[v, u] >= 255.0 * self.settings.sure_weight
        new = new[:, sure | ~self._in_free_space(new)]
        new = new[:, :room]
        if new.shape[1]:
            self.store.add(new, keyframe.anchor)
        return InsertionResult("ok", new.shape[1], 0, *known)

    def _in_free_space(self, params: np.ndarray) -> np.ndarray:
        """Return bool [N]: Gaussians that float in front of a trusted surface of one of the newest keyframes.

        `params` are the Gaussians, float32 [14, N] in the map frame.
        """
        votes = np.zeros(params.shape[1], np.int32)
        for id in self._newest:
            keyframe = self.keyframes[id]
            T_map_camera = self.T_map_camera(keyframe)
            count_votes(params, len(votes), keyframe.levels[HALF], T_map_camera, self.settings, votes)
        return votes > 0

    def _prune(self, keyframe: StoredKeyframe) -> int:
        """Remove faint Gaussians and Gaussians with enough carving votes; return the number removed."""
        s, store = self.settings, self.store
        self.engine.vote_carving(keyframe.levels[HALF], self.T_map_camera(keyframe), s)
        faint = np.log(s.prune_opacity / (1.0 - s.prune_opacity))
        keep = store.survivors(s.carve_votes, faint)
        # Compaction copies all arrays: only from 0.5 % of the Gaussians.
        return store.keep(keep) if np.count_nonzero(~keep) > store.count // 200 else 0

    # --- optimisation ------------------------------------------------------------------------------

    def optimise(self, half: int | None = None, full: int | None = None) -> float:
        """Do `half` steps at half size, then `full` at full size, on random keyframes; return the mean loss.

        The defaults are the numbers of steps per keyframe in the settings.
        """
        half = self.settings.half_iterations if half is None else half
        full = self.settings.full_iterations if full is None else full
        if not self.keyframes or self.store.count == 0:
            return 0.0
        sizes = (*repeat(HALF, half), *repeat(FULL, full))
        return self._run([(self._draw(), size) for size in sizes], refining=False)

    @property
    def has_owed_steps(self) -> bool:
        """Return whether `optimise_owed` would do steps."""
        return self.plan.count > 0 and bool(self.keyframes) and self.store.count > 0

    def optimise_owed(self) -> None:
        """Do the next piece of owed steps. Steps that `must_stop` prevents are owed still."""
        if not self.has_owed_steps or (steps := self.plan.take(HALF)) is None:
            return
        before = self.steps
        if steps.kind == "refine":
            self.refine(steps.count, steps.size)
        elif steps.size == HALF:
            self.optimise(steps.count, 0)
        else:
            self.optimise(0, steps.count)
        self.plan.owe(steps.kind, steps.size, steps.count - (self.steps - before), first=True)

    def refine(self, iterations: int, size: int = FULL) -> float:
        """Do `iterations` steps on keyframes in random order, each equally often; return the mean loss."""
        ids: list[int] = []
        drawn: list[tuple[StoredKeyframe, int]] = []
        for _ in range(iterations):
            if not ids:
                ids = list(self._random.permutation(sorted(self.keyframes)))
            drawn.append((self.keyframes[int(ids.pop())], size))
        return self._run(drawn, refining=True)

    def _draw(self) -> StoredKeyframe:
        """Return a random keyframe: with probability 1/2 one of the newest, else any."""
        pool = self._newest if self._random.random() < 0.5 else list(self.keyframes)
        return self.keyframes[pool[int(self._random.integers(len(pool)))]]

    def step(self, keyframe: StoredKeyframe, size: int, *, refining: bool = False) -> float:
        """Optimise by one step on a keyframe (render, loss, backward pass, Adam); return the loss.

        `size` is FULL or HALF; `refining` selects the lower step size of the centres.
        """
        return self._run([(keyframe, size)], refining=refining)

    def _run(self, drawn: list[tuple[StoredKeyframe, int]], *, refining: bool) -> float:
        """Let the engine do one step per (keyframe, size); return the mean loss, 0 without any step."""
        s = self.settings
        steps = [
            OptimiserStep(
                keyframe, size, s.ssim_weight > 0.0 and (self.steps + i) % s.ssim_every == 0, refining
            )
            for i, (keyframe, size) in enumerate(drawn)
        ]
        before, asked = self.steps, count()

        def must_stop() -> bool:  # asked before each step
            self.steps = before + next(asked)
            return self.must_stop()

        losses = self.engine.optimise(steps, self.T_map_anchor, s, must_stop)
        self.steps = before + len(losses)
        return float(np.mean(losses)) if losses else 0.0
