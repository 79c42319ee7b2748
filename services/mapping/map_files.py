"""The files of the option `save`: splats.ply and keyframes.tum."""

from __future__ import annotations

from itertools import chain
from pathlib import Path

import numpy as np

from beamsplat.common.harmonics.basis import coefficients
from beamsplat.common.mapfiles.ply import write_map
from beamsplat.services.mapping.chunks import disk_params
from beamsplat.services.mapping.mapper import Mapper


def write_files(folder: Path, mapper: Mapper, stamps_ns: np.ndarray, T_map_body: np.ndarray) -> int:
    """Write all Gaussians, with those that are on disk only, and the keyframe poses into a folder.

    Args:
        stamps_ns: of the keyframes, int64 [K], ascending.
        T_map_body: their poses, float64 [K, 4, 4].

    Returns:
        The number of Gaussians.

    Raises:
        OSError, UserError: the files cannot be written.
    """
    store, degree = mapper.store, mapper.store.degree
    on_disk = (part for anchor in list(store.paged_out) for part in disk_params(mapper, anchor, degree))
    params = chain([store.with_harmonics()], on_disk)
    count = store.count + store.paged_out_count
    write_map(folder, count, params, stamps_ns, T_map_body, 3 * coefficients(degree))
    return count
