"""Kernels of the pose graph optimisation: normal equations with eliminated nodes, and back substitution."""

from __future__ import annotations

import math

import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.services.localization.lidar2d import se2


@kernel
def linearise(
    pose_map_submap: np.ndarray, pose_map_node: np.ndarray, z: np.ndarray, e: np.ndarray, Js: np.ndarray
) -> None:
    """Write the residual e [3] of a constraint and its Jacobian Js [3, 3] with respect to the submap pose.

    `z` is the measured pose_submap_node. The Jacobian with respect to the node pose is R^T (not written),
    where R is the rotation of the submap.
    """
    c, s = math.cos(pose_map_submap[2]), math.sin(pose_map_submap[2])
    dx, dy = pose_map_node[0] - pose_map_submap[0], pose_map_node[1] - pose_map_submap[1]
    lx, ly = c * dx + s * dy, -s * dx + c * dy
    e[0], e[1], e[2] = lx - z[0], ly - z[1], se2.wrap(pose_map_node[2] - pose_map_submap[2] - z[2])
    Js[0, 0], Js[0, 1], Js[0, 2] = -c, -s, ly
    Js[1, 0], Js[1, 1], Js[1, 2] = s, -c, -lx
    Js[2, 0], Js[2, 1], Js[2, 2] = 0.0, 0.0, -1.0


@kernel
def _mul(A: np.ndarray, B: np.ndarray, out: np.ndarray, transpose_a: bool) -> None:
    for i in range(3):
        for j in range(3):
            t = 0.0
            for k in range(3):
                t += (A[k, i] if transpose_a else A[i, k]) * B[k, j]
            out[i, j] = t


@kernel
def invert3(A: np.ndarray, out: np.ndarray) -> None:
    """Write the inverse of a matrix [3, 3] to `out`, by cofactors."""
    c00 = A[1, 1] * A[2, 2] - A[1, 2] * A[2, 1]
    c01 = A[1, 2] * A[2, 0] - A[1, 0] * A[2, 2]
    c02 = A[1, 0] * A[2, 1] - A[1, 1] * A[2, 0]
    d = 1.0 / (A[0, 0] * c00 + A[0, 1] * c01 + A[0, 2] * c02)
    out[0, 0], out[1, 0], out[2, 0] = c00 * d, c01 * d, c02 * d
    out[0, 1] = (A[0, 2] * A[2, 1] - A[0, 1] * A[2, 2]) * d
    out[1, 1] = (A[0, 0] * A[2, 2] - A[0, 2] * A[2, 0]) * d
    out[2, 1] = (A[0, 1] * A[2, 0] - A[0, 0] * A[2, 1]) * d
    out[0, 2] = (A[0, 1] * A[1, 2] - A[0, 2] * A[1, 1]) * d
    out[1, 2] = (A[0, 2] * A[1, 0] - A[0, 0] * A[1, 2]) * d
    out[2, 2] = (A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]) * d


@kernel
def reduce_nodes(
    submap: np.ndarray,
    z: np.ndarray,
    info: np.ndarray,
    robust: np.ndarray,
    first: np.ndarray,  # int64 [N + 1] edges of each node
    pair_of: np.ndarray,  # int64 [P] index of the block for each ordered pair of edges of each node
    submap_poses: np.ndarray,
    node_poses: np.ndarray,
    scale2: float,
    limit2: float,
    blocks: np.ndarray,  # out float64 [B, 3, 3]
    rhs: np.ndarray,  # out float64 [S, 3]
    W: np.ndarray,  # work [E, 3, 3] coupling submap-node
    Hnn_inv: np.ndarray,  # out float64 [N, 3, 3]
    bn: np.ndarray,  # out float64 [N, 3]
    chi2: np.ndarray,  # out float64 [E]
) -> float:
    """Compute the normal equations of the submaps with every node eliminated (Schur complement).

    Loop closure constraints (`robust`) have a Geman-McClure loss with the squared scale `scale2`, the others
    with `limit2`. Returns the robust cost.
    """
    blocks[:] = 0.0
    rhs[:] = 0.0
    e, Js, Jn, Om = np.empty(3), np.empty((3, 3)), np.zeros((3, 3)), np.empty((3, 3))
    OJs, OJn, Hss, Hnn, t1 = (
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
    )
    cost, p = 0.0, 0
    for n in range(node_poses.shape[0]):
        lo, hi = first[n], first[n + 1]
        Hnn[:] = 0.0
        bn[n] = 0.0
        p0 = p
        for k in range(lo, hi):
            s = submap[k]
            linearise(submap_poses[s], node_poses[n], z[k], e, Js)
            Jn[0, 0], Jn[0, 1], Jn[1, 0], Jn[1, 1], Jn[2, 2] = -Js[0, 0], -Js[0, 1], -Js[1, 0], -Js[1, 1], 1.0
            c2 = 0.0
            for i in range(3):
                for j in range(3):
                    c2 += e[i] * info[k, i, j] * e[j]
            chi2[k] = c2
            bound = scale2 if robust[k] else limit2
            root = bound / (bound + c2)
            w = root * root
            cost += root * c2
            for i in range(3):
                for j in range(3):
                    Om[i, j] = w * info[k, i, j]
            _mul(Om, Js, OJs, False)
            _mul(Om, Jn, OJn, False)
            _mul(Js, OJs, Hss, True)
            _mul(Js, OJn, W[k], True)
            _mul(Jn, OJn, t1, True)
            block = blocks[pair_of[p0 + (k - lo) * (hi - lo) + (k - lo)]]
            for i in range(3):
                for j in range(3):
                    Hnn[i, j] += t1[i, j]
                    block[i, j] += Hss[i, j]
                    rhs[s, i] -= OJs[j, i] * e[j]
                    bn[n, i] -= OJn[j, i] * e[j]
        p += (hi - lo) * (hi - lo)
        if hi == lo:
            continue
        for i in range(3):
            Hnn[i, i] += 1e-6
        invert3(Hnn, Hnn_inv[n])
        for k in range(lo, hi):
            _mul(W[k], Hnn_inv[n], t1, False)
            for i in range(3):
                for j in range(3):
                    rhs[submap[k], i] -= t1[i, j] * bn[n, j]
            for m in range(lo, hi):
                block = blocks[pair_of[p0 + (k - lo) * (hi - lo) + (m - lo)]]
                for i in range(3):
                    for j in range(3):
                        t = 0.0
                        for q in range(3):
                            t += t1[i, q] * W[m, j, q]
                        block[i, j] -= t
    return cost


@kernel
def substitute(
    submap: np.ndarray,
    first: np.ndarray,
    W: np.ndarray,
    Hnn_inv: np.ndarray,
    bn: np.ndarray,
    dx: np.ndarray,
    submap_poses: np.ndarray,
    node_poses: np.ndarray,
) -> None:
    """Update all poses in place: submap poses by `dx` float64 [S, 3], node poses by back substitution."""
    b = np.empty(3)
    for n in range(node_poses.shape[0]):
        if first[n] == first[n + 1]:
            continue
        b[:] = bn[n]
        for k in range(first[n], first[n + 1]):
            for i in range(3):
                for j in range(3):
                    b[i] -= W[k, j, i] * dx[submap[k], j]
        for i in range(3):
            for j in range(3):
                node_poses[n, i] += Hnn_inv[n, i, j] * b[j]
        node_poses[n, 2] = se2.wrap(node_poses[n, 2])
    for s in range(submap_poses.shape[0]):
        for i in range(3):
            submap_poses[s, i] += dx[s, i]
        submap_poses[s, 2] = se2.wrap(submap_poses[s, 2])


@kernel
def edge_pairs(submap: np.ndarray, first: np.ndarray, n_submaps: int, keys: np.ndarray) -> None:
    """Write the block key submap_i * n_submaps + submap_j of every ordered pair of edges of each node."""
    p = 0
    for n in range(first.shape[0] - 1):
        for k in range(first[n], first[n + 1]):
            for m in range(first[n], first[n + 1]):
                keys[p] = np.int64(submap[k]) * n_submaps + submap[m]
                p += 1
