"""Interface of depth sources, and the table of their names.

A source takes one undistorted image (geometric sources also the beams at the image time) and returns a dense
estimate of the same size. `Estimate.kind` defines the meaning of the values; fusion scales them to metres.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Any, Literal, Protocol, get_type_hints

import numpy as np
from pydantic import PydanticSchemaGenerationError, TypeAdapter, ValidationError

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.beams import NO_BEAMS, Beams
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.plugins import is_class_path, load_class
from beamsplat.services.depth.model_files import find_model

Kind = Literal["metric", "relative", "disparity", "none"]


@dataclass(frozen=True)
class DepthInput:
    """Input of a depth source: one image with its camera model and the beams at the image time."""

    stamp_ns: int
    image_rgb: np.ndarray  # uint8 [H, W, 3], undistorted
    camera: Pinhole  # without distortion, of the image size
    T_body_camera: np.ndarray = field(default_factory=lambda: np.eye(4))
    beams: Beams = NO_BEAMS
    floor_known: bool = False  # the height in T_body_camera is reliable


@dataclass(frozen=True)
class Estimate:
    """A dense depth estimate: metric (metres), relative (up to a factor) or disparity (a / z + b)."""

    values: np.ndarray  # float32 [H, W] of the image size, NaN = unknown
    kind: Kind
    status: str = "ok"  # else the reason why the values must not be used
    confidence: np.ndarray | None = None  # float32 [H, W] in [0, 1], comparable within one image only

    @property
    def ok(self) -> bool:
        return self.status == "ok"


class DepthSource(Protocol):
    """Interface of an estimator of dense depth from one image."""

    def estimate(self, view: DepthInput) -> Estimate:
        """Return the estimate for one image; for an unusable image, set `status` and raise no exception."""
        ...


# name -> "module:Class"; the class takes its options as keyword arguments and checks them.
SOURCES: dict[str, str] = {
    "fastdepth": "beamsplat.services.depth.fastdepth:FastDepth",
    "unidepth": "beamsplat.services.depth.unidepth:UniDepth",
    "depth_anything": "beamsplat.services.depth.depth_anything:DepthAnything",
    "depth_anything_metric": "beamsplat.services.depth.depth_anything:DepthAnythingMetric",
    "depth_anything_3": "beamsplat.services.depth.depth_anything_3:DepthAnything3",
    "depth_anything_3_metric": "beamsplat.services.depth.depth_anything_3:DepthAnything3Metric",
    "moge": "beamsplat.services.depth.moge:MoGe",
    "stixel": "beamsplat.services.depth.stixel:Stixel",
    "recorded": "beamsplat.services.depth.recorded:RecordedDepth",
    "none": "beamsplat.services.depth.no_depth:NoDepth",
}

# Sources that use the beams at the time of the image; the others do not wait for them.
USES_BEAMS = frozenset({"stixel", "moge"})

# Sources that do not use the image, so that it is not decoded for them.
IGNORES_IMAGE = frozenset({"stixel", "recorded", "none"})


def source_class(name: str) -> type[DepthSource]:
    """Import and return the class of a depth source.

    Args:
        name: a key of `SOURCES`, or the path of a class of another package, "my_package.my_module:MySource".

    Raises:
        UserError: no such source, or a class that is not a depth source.
    """
    if is_class_path(name):
        cls = load_class(name, "depth.source")
        if not callable(getattr(cls, "estimate", None)):
            raise UserError(f"depth.source = {name!r}: the class has no method estimate(view)")
        return cls
    if name not in SOURCES:
        near = get_close_matches(name, SOURCES, 1)
        meant = f"did you mean {near[0]!r}? " if near else ""
        raise UserError(
            f"there is no depth source {name!r}; {meant}there are {', '.join(SOURCES)}, and 'module:Class' "
            "of a class of your own"
        )
    module_name, _, class_name = SOURCES[name].partition(":")
    return getattr(importlib.import_module(module_name), class_name)


def make_source(name: str, options: Mapping[str, Any] | None = None) -> DepthSource:
    """Create the depth source called `name` (see `source_class`) with the options of this source.

    Raises:
        UserError: no such source, an unknown option, or a model file that is missing or wrong.
    """
    cls = source_class(name)
    return cls(**_checked_options(name, cls, options or {}))


def check_source(name: str, options: Mapping[str, Any]) -> None:
    """Check name, options and files of a depth source, without loading its network.

    Raises:
        UserError: as `make_source`; whether a model file contains the correct network is not checked.
    """
    cls = source_class(name)
    checked = _checked_options(name, cls, options)
    if is_class_path(name):  # what its constructor costs is unknown
        return
    model = inspect.signature(cls).parameters.get("model")
    if model is None:
        cls(**checked)
    else:
        find_model(checked.get("model", model.default))


def uses_beams(name: str, source: DepthSource) -> bool:
    """Return whether a depth source reads `DepthInput.beams` (`uses_beams = True` in other packages)."""
    return name in USES_BEAMS or bool(getattr(source, "uses_beams", False))


def _checked_options(name: str, cls: type[DepthSource], options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options, after a check of their names and types against the signature of the constructor.

    Raises:
        UserError: an unknown or a missing option, or an option of another type.
    """
    signature = inspect.signature(cls)
    try:
        signature.bind(**options)
    except TypeError as error:
        known = ", ".join(signature.parameters) or "none"
        raise UserError(f"depth source {name}: {error} (options: {known})") from error
    hints = get_type_hints(cls.__init__)
    checked = dict(options)
    for option in options.keys() & hints.keys():
        try:
            checked[option] = TypeAdapter(hints[option]).validate_python(options[option])
        except ValidationError as error:
            text = error.errors(include_url=False)[0]["msg"]
            raise UserError(f"depth source {name}: {option} = {options[option]!r}: {text}") from error
        except PydanticSchemaGenerationError:  # an annotation of somebody's own class
            continue
    return checked


def check_depth_map(values: np.ndarray, min_known_share: float = 0.2) -> str:
    """Return "ok", or the reason why the output [H, W] of a network is not a depth map.

    `min_known_share`: least fraction of pixels that must have a value.
    """
    finite = np.isfinite(values)
    share = float(finite.mean()) if values.size else 0.0
    if share < min_known_share:
        return f"the network returned a number for only {share:.0%} of the image"
    known = values[finite]
    if not np.any(known > 0.0):
        return "the network returned no value above zero"
    spread = float(np.percentile(known, 95) - np.percentile(known, 5))
    if spread <= 1e-4 * float(np.median(np.abs(known)) + 1e-12):
        return "the network returned the same value everywhere"
    return "ok"
