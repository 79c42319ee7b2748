"""Depth sources: what they get, what they give, and the table of their names.

A source sees one undistorted picture (and, for geometric sources, the beams of that moment) and gives a
dense estimate of the picture's size. What its numbers mean is said by `kind`; scaling to metres is
fusion's business.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.beams import NO_BEAMS, Beams
from beamsplat.common.geometry.camera import Pinhole

Kind = Literal["metric", "relative", "disparity", "none"]


@dataclass(frozen=True)
class DepthInput:
    """One picture and what is known at its time."""

    stamp_ns: int
    image_rgb: np.ndarray  # uint8 [H, W, 3], undistorted
    camera: Pinhole  # without distortion, of the picture's size
    T_body_camera: np.ndarray = field(default_factory=lambda: np.eye(4))
    beams: Beams = NO_BEAMS
    floor_known: bool = False  # T_body_camera's height above the floor can be relied on


@dataclass(frozen=True)
class Estimate:
    """A dense guess. metric: metres; relative: up to a factor; disparity: a / z + b, nearer = larger."""

    values: np.ndarray  # float32 [H, W] of the picture's size; NaN = no answer
    kind: Kind
    status: str = "ok"  # else one sentence: why the values must not be used
    confidence: np.ndarray | None = None  # float32 [H, W] in [0, 1], ranking within this picture only

    @property
    def ok(self) -> bool:
        return self.status == "ok"


class DepthSource(Protocol):
    """A way to guess dense depth from one picture."""

    def estimate(self, view: DepthInput) -> Estimate:
        """The guess for one picture. Never raises for bad pictures: `status` says what is wrong."""
        ...


# name -> "module:Class"; the class takes its options as keyword arguments and checks them.
SOURCES: dict[str, str] = {
    "fastdepth": "beamsplat.services.depth.fastdepth:FastDepth",
    "unidepth": "beamsplat.services.depth.unidepth:UniDepth",
    "depth_anything": "beamsplat.services.depth.depth_anything:DepthAnything",
    "depth_anything_metric": "beamsplat.services.depth.depth_anything:DepthAnythingMetric",
    "stixel": "beamsplat.services.depth.stixel:Stixel",
    "recorded": "beamsplat.services.depth.recorded:RecordedDepth",
    "none": "beamsplat.services.depth.no_depth:NoDepth",
}

# These look at the beams of a picture's time; the others need not wait for them.
USES_BEAMS = frozenset({"stixel"})

# These never look at the picture itself: nobody needs to decode it for them.
IGNORES_IMAGE = frozenset({"stixel", "recorded", "none"})


def make_source(name: str, options: Mapping[str, Any] | None = None) -> DepthSource:
    """The source called `name`.

    Raises:
        UserError: no such source, an option it does not take, or a model that is missing or wrong.
    """
    if name not in SOURCES:
        raise UserError(f"there is no depth source {name!r}; there are {', '.join(SOURCES)}")
    module_name, _, class_name = SOURCES[name].partition(":")
    cls = getattr(importlib.import_module(module_name), class_name)
    try:
        return cls(**(options or {}))
    except TypeError as error:
        raise UserError(f"depth source {name}: {str(error).replace('__init__() ', '')}") from error


def check_depth_map(values: np.ndarray, min_known_share: float = 0.2) -> str:
    """ "ok", or one sentence on why a network's output [H, W] cannot be depth."""
    finite = np.isfinite(values)
    share = float(finite.mean()) if values.size else 0.0
    if share < min_known_share:
        return f"the network answered only {share:.0%} of the picture with a number"
    known = values[finite]
    if not np.any(known > 0.0):
        return "the network returned nothing above zero"
    spread = float(np.percentile(known, 95) - np.percentile(known, 5))
    if spread <= 1e-4 * float(np.median(np.abs(known)) + 1e-12):
        return "the network returned the same value everywhere"
    return "ok"
