"""Keynodes that slipped along a corridor: their own submap says one thing, several others another."""

from __future__ import annotations

import dataclasses
from collections import defaultdict

import numpy as np

from services.localization.lidar2d import se2
from services.localization.lidar2d.nodes import Constraint

REFUSED_CHI2 = 25.0  # a loop the optimiser overruled
AGREE_M = 0.15
AGREE_RAD = 0.05
WEAKEN = 1e-3


def slipped_nodes(
    constraints: list[Constraint],
    chi2: np.ndarray,  # float64 [E], in the order of the constraints
    T_map_submap: dict[int, np.ndarray],
) -> dict[int, np.ndarray]:
    """Keynodes whose overruled loops agree with each other, are at least two, come from two submaps or more
    and outnumber the loops that were accepted; with the pose T_map_node they agree on."""
    refused: dict[int, list[np.ndarray]] = defaultdict(list)
    accepted: dict[int, int] = defaultdict(int)
    for constraint, c2 in zip(constraints, chi2):
        if not constraint.loop:
            continue
        if c2 > REFUSED_CHI2:
            T = se2.compose(T_map_submap[constraint.submap], constraint.T_submap_node)
            refused[constraint.node].append(T)
        else:
            accepted[constraint.node] += 1
    slipped = {}
    for node, poses in refused.items():
        if len(poses) < 2 or len(poses) <= accepted[node]:
            continue
        off = se2.between_many(poses[0], np.array(poses))
        if np.hypot(off[:, 0], off[:, 1]).max() < AGREE_M and np.abs(off[:, 2]).max() < AGREE_RAD:
            slipped[node] = se2.compose(poses[0], off.mean(axis=0))
    return slipped


def weakened(constraints: list[Constraint], slipped: dict[int, np.ndarray]) -> list[Constraint]:
    """The edges of slipped keynodes into their own submaps lose their say."""
    return [
        dataclasses.replace(c, information=WEAKEN * c.information) if c.node in slipped and not c.loop else c
        for c in constraints
    ]
