"""`bench geometry`: what depth buys a map: picture and geometry over the weight of the depth terms."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.beams import NO_BEAMS
from beamsplat.common.geometry.depth_sigma import typical_sigma_m
from beamsplat.common.geometry.transforms import inverse
from beamsplat.services.depth.source import DepthInput, make_source, uses_beams
from beamsplat.services.fusion.inputs import FusionInput
from beamsplat.services.fusion.single_image import SingleImageFusion
from beamsplat.services.mapping.settings import MapperSettings
from beamsplat.services.mapping.warm import warm
from beamsplat.tools.bench.depth_priors import Prior, find_prior
from beamsplat.tools.bench.fused_prior import FusedDepthPrior
from beamsplat.tools.bench.mapping import Log, MapBenchSettings, map_and_score
from beamsplat.tools.evaluation.dataset import TruthDataset, load_dataset

WEIGHTS = (0.0, 0.05, 0.15, 0.5, 1.5)
# A view off the path is scored if an image of the mapped part was taken near it, in a similar direction.
_NEAR_M, _NEAR_RAD = 0.7, np.radians(40.0)
_FIGURES = (
    "psnr_offpath_db", "ssim_offpath", "depth_l1_offpath_m", "psnr_heldout_db", "gaussians",
)  # fmt: skip


@dataclass(frozen=True)
class GeometryBenchSettings:
    """Settings of one run of `bench geometry`."""

    weights: tuple[float, ...] = WEIGHTS  # of the depth loss, `MapperSettings.depth_weight`
    seconds: float | None = None  # of the drive that are mapped; None = all
    prior: str = "field"  # depth of the keyframes, as in `bench map`
    source: str = "stixel"  # depth source of fusion, with `prior` = "field"
    without_beams: str = ""  # depth source of a map without lidar; "" = without that map
    source_options: tuple[tuple[str, Any], ...] = ()  # of `without_beams`
    mapper: MapperSettings = field(default_factory=MapperSettings)
    threads: int = 1
    seed: int = 0


@dataclass(frozen=True)
class GeometryCase:
    """One map: its name in the table, the weights of its depth terms, and whether it knows the beams."""

    name: str
    depth_weight: float
    lidar_weight: float
    beams: bool = True


def run_geometry(path: Path, bench: GeometryBenchSettings, log: Log = lambda text: None) -> dict[str, Any]:
    """Map the same keyframes once for each case, and return the scores of the maps at views not mapped.

    All maps with beams have the same depth of keyframes, which also says where Gaussians are inserted; they
    differ in the weight of depth in the loss. Without beams, both come from a depth network alone.

    Raises:
        UserError: a weight is negative, the part of the drive has no view to score, or the source of the map
            without beams needs beams.
    """
    cases = list(cases_of(bench))
    recording = part_of(load_dataset(path), bench.seconds)
    prior = _Remembered(FusedDepthPrior(bench.source) if bench.prior == "field" else find_prior(bench.prior))
    alone = EstimatePrior(bench.without_beams, dict(bench.source_options)) if bench.without_beams else None
    warm()
    rows = []
    for number, case in enumerate(cases):
        log(f"{number + 1} of {len(cases)}: {case.name}")
        settings = replace(bench.mapper, depth_weight=case.depth_weight, lidar_weight=case.lidar_weight)
        run = MapBenchSettings(settings=settings, threads=bench.threads, seed=bench.seed)
        used = recording if case.beams else without_beams(recording)
        depth: Prior = prior if case.beams or alone is None else alone
        # The F-score needs the true surface of what was mapped, and only that of the whole home is known.
        scores, timer = map_and_score(used, run, depth, surface=bench.seconds is None)
        figures = {name: scores.get(name) for name in _FIGURES}
        figures |= {name: value for name, value in scores.items() if name.startswith("fscore")}
        rows.append({
            "case": case.name, "depth_weight": case.depth_weight, "lidar_weight": case.lidar_weight,
            "beams": case.beams, **figures, "cpu_s": timer.cpu_s,
        })  # fmt: skip
    return {
        "data": str(path), "seconds": recording.seconds, "prior": bench.prior, "source": bench.source,
        "images": len(recording.posed_images), "offpath_views": len(recording.offpath_views),
        "seed": bench.seed, "threads": bench.threads, "cases": rows,
    }  # fmt: skip


def cases_of(bench: GeometryBenchSettings) -> Iterator[GeometryCase]:
    """Yield the maps of a run: one for each weight, one without the term at the beams, one without lidar.

    Raises:
        UserError: a weight is negative or not finite, or there are no weights.
    """
    if not bench.weights or not all(np.isfinite(w) and w >= 0.0 for w in bench.weights):
        raise UserError(f"--weight {', '.join(map(str, bench.weights))}: expected numbers of at least 0")
    default = bench.mapper
    for weight in bench.weights:
        if weight == 0.0:
            yield GeometryCase("appearance only: no depth in the loss", 0.0, 0.0)
        else:
            yield GeometryCase(f"depth weight {weight:g}", weight, default.lidar_weight)
    yield GeometryCase(
        f"depth weight {default.depth_weight:g}, no term at the beams", default.depth_weight, 0.0
    )
    if bench.without_beams:
        yield GeometryCase(
            f"no lidar: depth of {bench.without_beams}", default.depth_weight, 0.0, beams=False
        )


def part_of(recording: TruthDataset, seconds: float | None) -> TruthDataset:
    """Return the first `seconds` of a recording, with the views off the path that it comes near to.

    Raises:
        UserError: no image or no view is left.
    """
    images = recording.posed_images
    if seconds is not None:
        last_ns = images[0].stamp_ns + round(seconds * 1e9)
        images = [image for image in images if image.stamp_ns <= last_ns]
    T = np.array([image.T_map_camera for image in images])
    views = []
    for view in recording.offpath_views:
        distance = np.linalg.norm(T[:, :3, 3] - view.T_map_camera[:3, 3], axis=1)
        cos = (np.einsum("nij,ij->n", T[:, :3, :3], view.T_map_camera[:3, :3]) - 1.0) / 2.0
        if np.any((distance < _NEAR_M) & (cos > np.cos(_NEAR_RAD))):
            views.append(view)
    if len(images) < 2 or not views:
        raise UserError(
            f"{recording.path}: no view off the path is near its first {seconds:g} s; use more seconds"
            if seconds is not None
            else f"{recording.path}: has no views off the path (extra_views/)"
        )
    return replace(recording, posed_images=images, offpath_views=views)


def without_beams(recording: TruthDataset) -> TruthDataset:
    """Return a recording whose images have no beams."""
    images = [replace(image, beams=NO_BEAMS) for image in recording.posed_images]
    return replace(recording, posed_images=images)


class EstimatePrior:
    """Depth prior of a depth network alone: method `given` of fusion, which nothing corrects.

    Raises:
        UserError: no such source, or it needs beams.
    """

    def __init__(self, source: str, options: dict[str, Any] | None = None) -> None:
        self._source = make_source(source, options or {})
        if source == "none" or uses_beams(source, self._source):
            raise UserError(f"--without-beams {source}: expected a depth network, which needs no beams")
        self._name = source

    def __call__(self, recording: TruthDataset, index: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Return (depth_m, sigma_m) float32 [H, W] of image `index`; None if the network rejects it.

        Raises:
            UserError: the network's depth is not in metres, so that it needs beams.
        """
        image, rgb = recording.posed_images[index], recording.image(index)
        view = DepthInput(image.stamp_ns, rgb, recording.camera, recording.T_body_camera)
        estimate = self._source.estimate(view)
        if estimate.kind != "metric":
            raise UserError(
                f"--without-beams {self._name}: its depth is {estimate.kind}, and only beams give it metres"
            )
        if not estimate.ok:
            return None
        T_map_body = image.T_map_camera @ inverse(recording.T_body_camera)
        frame = FusionInput(image.stamp_ns, rgb, T_map_body, NO_BEAMS, estimate.values, "metric")
        fused = SingleImageFusion(recording.camera, recording.T_body_camera, "given").fuse(
            frame, keyframe=True
        )
        return (fused.depth_m, typical_sigma_m(fused.depth_m, fused.sigma_m)) if fused.ok else None


class _Remembered:
    """A depth prior that computes each image once: all maps get the same depth, and it costs CPU once."""

    def __init__(self, prior: Prior) -> None:
        self._prior = prior
        self._known: dict[int, tuple[np.ndarray, np.ndarray] | None] = {}

    def __call__(self, recording: TruthDataset, index: int) -> tuple[np.ndarray, np.ndarray] | None:
        if index not in self._known:
            self._known[index] = self._prior(recording, index)
        return self._known[index]
