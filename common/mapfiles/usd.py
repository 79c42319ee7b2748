"""Gaussians as `.usda` files: OpenUSD's `ParticleField3DGaussianSplat`, in the map frame (metres, z up).

Text with the shortest decimal numbers that give the same 32-bit values. Programs read the schema since
OpenUSD 26.03; https://openusd.org/release/user_guides/schemas/usdVol/ParticleField3DGaussianSplat.html
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from beamsplat.common.files.persist import write_atomically
from beamsplat.common.mapfiles.ply import SH_C0
from beamsplat.common.raster.layout import COLOUR, MEAN, OPACITY, QUAT, SCALE

_SIGMAS = 3.0  # extent of a Gaussian, in standard deviations along its longest axis
_HEAD = """#usda 1.0
(
    defaultPrim = "Map"
    doc = "Written by BeamSplat"
    metersPerUnit = 1
    upAxis = "Z"
)

def ParticleField3DGaussianSplat "Map"
{
"""


def write_usd(path: Path, params: np.ndarray) -> None:
    """Write Gaussians float32 [14, N], in the map frame, atomically.

    Raises:
        ValueError: there are no Gaussians.
        OSError: the file cannot be written.
    """
    if params.shape[1] == 0:
        raise ValueError("the map has no Gaussians: a USD file would show nothing")
    rows = params.T.astype(np.float64)
    scales = np.exp(rows[:, SCALE:QUAT])
    quats = rows[:, QUAT:OPACITY] / np.linalg.norm(rows[:, QUAT:OPACITY], axis=1, keepdims=True)
    reach = _SIGMAS * scales.max(axis=1, keepdims=True)
    extent = [(rows[:, MEAN:SCALE] - reach).min(axis=0), (rows[:, MEAN:SCALE] + reach).max(axis=0)]
    attributes = (
        ("float3[] extent", np.array(extent)),
        ("point3f[] positions", rows[:, MEAN:SCALE]),
        ("quatf[] orientations", quats),
        ("float3[] scales", scales),
        ("float[] opacities", 1.0 / (1.0 + np.exp(-rows[:, OPACITY]))),
        ("float3[] radiance:sphericalHarmonicsCoefficients", (rows[:, COLOUR:] - 0.5) / SH_C0),
    )
    body = "".join(f"    {name} = [{_text(values)}]\n" for name, values in attributes)
    degree = "    uniform int radiance:sphericalHarmonicsDegree = 0\n"
    write_atomically(Path(path), f"{_HEAD}{body}{degree}}}\n".encode())


def _text(values: np.ndarray) -> str:
    """Return numbers [N], or tuples [N, K], as the elements of a USD array."""
    short = np.char.mod("%.9g", values.astype(np.float32)).astype(object)
    if values.ndim == 1:
        return ", ".join(short)
    return ", ".join(f"({', '.join(row)})" for row in short)
