"""Sparse robust pose graph optimisation over submap and node poses.

The structure is that of sparse pose adjustment (Konolige et al. 2010) as Cartographer uses it: constraints
from submaps to nodes. It is solved like bundle adjustment: a node has constraints to a few submaps only, so
its 3x3 block is eliminated exactly (Schur complement) and only the submap poses are solved for. Loop closure
constraints have a Geman-McClure loss whose scale shrinks during the iterations (graduated non-convexity, Yang
et al. 2020).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg

from beamsplat.services.localization.lidar2d.graph_kernels import edge_pairs, reduce_nodes, substitute

DENSE_SUBMAPS = 250  # above this number of submaps the reduced system is solved with sparse matrices
INNER_SCALE2 = 1e4  # squared loss scale of constraints within a submap, which are rarely outliers
SHRINK = 5.0  # factor per iteration by which the squared loss scale of loop closures falls to its final value


@dataclass(frozen=True)
class ConstraintArrays:
    """Constraints as arrays, ordered by node; `submap` and `node` are row numbers of the pose arrays."""

    submap: np.ndarray  # int32 [E]
    node: np.ndarray  # int32 [E], non-decreasing
    pose_submap_node: np.ndarray  # float64 [E, 3]
    information: np.ndarray  # float64 [E, 3, 3]
    robust: np.ndarray  # bool [E], True for loop closures


@dataclass(frozen=True)
class GraphSolution:
    """Optimised poses and the residual of each constraint."""

    pose_map_submap: np.ndarray  # float64 [S, 3]
    pose_map_node: np.ndarray  # float64 [N, 3]
    chi2: np.ndarray  # float64 [E], squared residuals weighted with the information
    iterations: int


def optimise(
    pose_map_submap: np.ndarray,  # float64 [S, 3] start
    pose_map_node: np.ndarray,  # float64 [N, 3] start
    edges: ConstraintArrays,
    fixed: Sequence[int] = (0,),  # rows of the submaps that are held constant
    final_scale2: float = 9.0,
    iterations: int = 16,
    anneal: bool = True,
) -> GraphSolution:
    """Optimise all poses: minimise the sum of rho(e^T Omega e) over the constraints.

    e is the difference of the measured pose_submap_node and inverse(pose_map_submap) * pose_map_node, Omega
    the information of the constraint, rho the robust loss.

    Args:
        final_scale2: squared scale of the robust loss in the last iterations, in units of chi^2.
        iterations: maximum number of iterations.
        anneal: start with a large scale of the loss; not needed where all constraints agree with the start.
    """
    submap_poses, node_poses = (
        pose_map_submap.astype(np.float64).copy(),
        pose_map_node.astype(np.float64).copy(),
    )
    n_submaps, n_nodes = len(submap_poses), len(node_poses)
    first = np.searchsorted(edges.node, np.arange(n_nodes + 1)).astype(np.int64)
    keys = np.empty(int((np.diff(first) ** 2).sum()), dtype=np.int64)
    edge_pairs(edges.submap, first, n_submaps, keys)
    unique, pair_of = np.unique(keys, return_inverse=True)
    row, col = unique // n_submaps, unique % n_submaps
    blocks, rhs = np.empty((len(unique), 3, 3)), np.empty((n_submaps, 3))
    W, Hnn_inv = np.empty((len(edges.node), 3, 3)), np.empty((n_nodes, 3, 3))
    bn, chi2 = np.empty((n_nodes, 3)), np.empty(len(edges.node))
    done, scale2 = 0, math.inf if anneal else final_scale2
    while done < iterations:
        done += 1
        # The first iteration has a very large scale and so accepts every loop closure; outliers are visible
        # only after it.
        reduce_nodes(
            edges.submap,
            edges.pose_submap_node,
            edges.information,
            edges.robust,
            first,
            pair_of,
            submap_poses,
            node_poses,
            min(scale2, 1e12),
            max(min(scale2, 1e12), INNER_SCALE2),
            blocks,
            rhs,
            W,
            Hnn_inv,
            bn,
            chi2,
        )
        settled = scale2 == final_scale2
        if math.isinf(scale2):
            scale2 = 4.0 * float(chi2[edges.robust].max()) if edges.robust.any() else final_scale2
        scale2 = max(scale2 / SHRINK, final_scale2)
        dx = _solve(blocks, row, col, rhs, fixed)
        substitute(edges.submap, first, W, Hnn_inv, bn, dx, submap_poses, node_poses)
        if settled and np.abs(dx).max() < 1e-5:
            break
    reduce_nodes(
        edges.submap,
        edges.pose_submap_node,
        edges.information,
        edges.robust,
        first,
        pair_of,
        submap_poses,
        node_poses,
        final_scale2,
        INNER_SCALE2,
        blocks,
        rhs,
        W,
        Hnn_inv,
        bn,
        chi2,
    )
    return GraphSolution(submap_poses, node_poses, chi2, done)


def _solve(
    blocks: np.ndarray, row: np.ndarray, col: np.ndarray, rhs: np.ndarray, fixed: Sequence[int]
) -> np.ndarray:
    """Solve the reduced normal equations for the updates of the submap poses, float64 [S, 3]."""
    n = len(rhs)
    diagonal = 1e-6 * np.ones(3 * n)
    for row_fixed in fixed:
        diagonal[3 * row_fixed : 3 * row_fixed + 3] = 1e12
    if n <= DENSE_SUBMAPS:
        A = np.zeros((n, 3, n, 3))
        A[row, :, col, :] = blocks
        dense = A.reshape(3 * n, 3 * n)
        dense[np.arange(3 * n), np.arange(3 * n)] += diagonal
        factor = scipy.linalg.cho_factor(dense, lower=True, overwrite_a=True, check_finite=False)
        return scipy.linalg.cho_solve(factor, rhs.ravel(), check_finite=False).reshape(n, 3)
    rows = np.repeat(3 * row[:, None] + np.arange(3), 3, axis=1).ravel()
    cols = np.tile(3 * col[:, None] + np.arange(3), (1, 3)).ravel()
    sparse = scipy.sparse.coo_matrix((blocks.ravel(), (rows, cols)), shape=(3 * n, 3 * n)).tocsc()
    sparse = sparse + scipy.sparse.diags(diagonal, format="csc")
    lu = scipy.sparse.linalg.splu(sparse, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    return lu.solve(rhs.ravel()).reshape(n, 3)
