"""Sparse robust pose graph: submaps and nodes, edges from submap to node, nodes eliminated first.

The structure of sparse pose adjustment (Konolige et al. 2010) as Cartographer uses it, solved like bundle
adjustment: a node only touches a handful of submaps, so its 3x3 block is eliminated exactly (Schur
complement) and only the submap poses are left to solve for. Loop edges have a Geman-McClure loss whose
scale shrinks during the iterations (graduated non-convexity, Yang et al. 2020).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from numba import njit

from services.localization.lidar2d import se2

DENSE_SUBMAPS = 250  # beyond this the reduced system is solved as a sparse one
SHRINK = 5.0  # the squared scale of the loop edges falls by this factor per iteration until the final one


@dataclass(frozen=True)
class Edges:
    """Measured poses of nodes in submaps; rows ordered by node."""

    submap: np.ndarray  # int32 [E]
    node: np.ndarray  # int32 [E], non-decreasing
    T_submap_node: np.ndarray  # float64 [E, 3]
    information: np.ndarray  # float64 [E, 3, 3]
    robust: np.ndarray  # bool [E], loop edges


@dataclass(frozen=True)
class GraphSolution:
    """Optimised poses and what each edge says about them."""

    T_map_submap: np.ndarray  # float64 [S, 3]
    T_map_node: np.ndarray  # float64 [N, 3]
    chi2: np.ndarray  # float64 [E] squared, information weighted residuals
    iterations: int


@njit(nogil=True, cache=True, error_model="numpy")
def _linearise(T_s: np.ndarray, T_n: np.ndarray, z: np.ndarray, e: np.ndarray, Js: np.ndarray) -> None:
    """Residual [3] and its Jacobian by the submap [3, 3]; that by the node is the rotation R_s'."""
    c, s = math.cos(T_s[2]), math.sin(T_s[2])
    dx, dy = T_n[0] - T_s[0], T_n[1] - T_s[1]
    lx, ly = c * dx + s * dy, -s * dx + c * dy
    e[0], e[1], e[2] = lx - z[0], ly - z[1], se2.wrap(T_n[2] - T_s[2] - z[2])
    Js[0, 0], Js[0, 1], Js[0, 2] = -c, -s, ly
    Js[1, 0], Js[1, 1], Js[1, 2] = s, -c, -lx
    Js[2, 0], Js[2, 1], Js[2, 2] = 0.0, 0.0, -1.0


@njit(nogil=True, cache=True, error_model="numpy")
def _mul(A: np.ndarray, B: np.ndarray, out: np.ndarray, transpose_a: bool) -> None:
    for i in range(3):
        for j in range(3):
            t = 0.0
            for k in range(3):
                t += (A[k, i] if transpose_a else A[i, k]) * B[k, j]
            out[i, j] = t


@njit(nogil=True, cache=True, error_model="numpy")
def _invert(A: np.ndarray, out: np.ndarray) -> None:
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


@njit(nogil=True, cache=True, error_model="numpy", fastmath=True)
def cholesky_solve(A: np.ndarray, x: np.ndarray) -> bool:
    """x <- A^-1 x for symmetric positive definite A [n, n] (destroyed); False if it is not.

    By rows inside the envelope: submaps in time order give a narrow one. Own code, because BLAS starts
    threads that spin for systems this small.
    """
    n = A.shape[0]
    start = np.empty(n, dtype=np.int64)
    for i in range(n):
        k = 0
        while k < i and A[i, k] == 0.0:
            k += 1
        start[i] = k
        for j in range(k, i):
            t = A[i, j]
            for q in range(max(k, start[j]), j):
                t -= A[i, q] * A[j, q]
            A[i, j] = t / A[j, j]
        t = A[i, i]
        for q in range(k, i):
            t -= A[i, q] * A[i, q]
        if not t > 0.0:
            return False
        A[i, i] = math.sqrt(t)
        t = x[i]
        for q in range(k, i):
            t -= A[i, q] * x[q]
        x[i] = t / A[i, i]
    for i in range(n - 1, -1, -1):
        x[i] /= A[i, i]
        for q in range(start[i], i):
            x[q] -= A[i, q] * x[i]
    return True


@njit(nogil=True, cache=True, error_model="numpy")
def _reduce(
    submap: np.ndarray, z: np.ndarray, info: np.ndarray, robust: np.ndarray,
    first: np.ndarray,  # int64 [N + 1] edges of each node
    pair_of: np.ndarray,  # int64 [P] index of the block for each ordered pair of edges of each node
    T_s: np.ndarray, T_n: np.ndarray, scale2: float, limit2: float,
    blocks: np.ndarray,  # out float64 [B, 3, 3]
    rhs: np.ndarray,  # out float64 [S, 3]
    W: np.ndarray,  # work [E, 3, 3] coupling submap-node
    Hnn_inv: np.ndarray,  # out float64 [N, 3, 3]
    bn: np.ndarray,  # out float64 [N, 3]
    chi2: np.ndarray,  # out float64 [E]
) -> float:  # fmt: skip
    """Normal equations with every node eliminated. Returns the robust cost."""
    blocks[:] = 0.0
    rhs[:] = 0.0
    e, Js, Jn, O = np.empty(3), np.empty((3, 3)), np.zeros((3, 3)), np.empty((3, 3))
    OJs, OJn, Hss, Hnn, t1, t2 = (np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)),
                                  np.empty((3, 3)), np.empty((3, 3)))  # fmt: skip
    cost, p = 0.0, 0
    for n in range(T_n.shape[0]):
        lo, hi = first[n], first[n + 1]
        Hnn[:] = 0.0
        bn[n] = 0.0
        p0 = p
        for k in range(lo, hi):
            s = submap[k]
            _linearise(T_s[s], T_n[n], z[k], e, Js)
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
                    O[i, j] = w * info[k, i, j]
            _mul(O, Js, OJs, False)
            _mul(O, Jn, OJn, False)
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
        _invert(Hnn, Hnn_inv[n])
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


@njit(nogil=True, cache=True, error_model="numpy")
def _substitute(
    submap: np.ndarray, first: np.ndarray, W: np.ndarray, Hnn_inv: np.ndarray, bn: np.ndarray, dx: np.ndarray,
    T_s: np.ndarray, T_n: np.ndarray,
) -> None:  # fmt: skip
    b = np.empty(3)
    for n in range(T_n.shape[0]):
        if first[n] == first[n + 1]:
            continue
        b[:] = bn[n]
        for k in range(first[n], first[n + 1]):
            for i in range(3):
                for j in range(3):
                    b[i] -= W[k, j, i] * dx[submap[k], j]
        for i in range(3):
            for j in range(3):
                T_n[n, i] += Hnn_inv[n, i, j] * b[j]
        T_n[n, 2] = se2.wrap(T_n[n, 2])
    for s in range(T_s.shape[0]):
        for i in range(3):
            T_s[s, i] += dx[s, i]
        T_s[s, 2] = se2.wrap(T_s[s, 2])


@njit(nogil=True, cache=True, error_model="numpy")
def _pairs(submap: np.ndarray, first: np.ndarray, n_submaps: int, keys: np.ndarray) -> None:
    p = 0
    for n in range(first.shape[0] - 1):
        for k in range(first[n], first[n + 1]):
            for m in range(first[n], first[n + 1]):
                keys[p] = np.int64(submap[k]) * n_submaps + submap[m]
                p += 1


def optimise(
    T_map_submap: np.ndarray,  # float64 [S, 3] start
    T_map_node: np.ndarray,  # float64 [N, 3] start
    edges: Edges,
    fixed: Sequence[int] = (0,),  # rows of the submaps that do not move
    final_scale2: float = 9.0,
    iterations: int = 16,
) -> GraphSolution:
    """Minimise sum rho(e' Omega e), e = T_submap_node (-) inverse(T_map_submap) T_map_node."""
    T_s, T_n = T_map_submap.astype(np.float64).copy(), T_map_node.astype(np.float64).copy()
    n_submaps, n_nodes = len(T_s), len(T_n)
    first = np.searchsorted(edges.node, np.arange(n_nodes + 1)).astype(np.int64)
    keys = np.empty(int((np.diff(first) ** 2).sum()), dtype=np.int64)
    _pairs(edges.submap, first, n_submaps, keys)
    unique, pair_of = np.unique(keys, return_inverse=True)
    row, col = unique // n_submaps, unique % n_submaps
    blocks, rhs = np.empty((len(unique), 3, 3)), np.empty((n_submaps, 3))
    W, Hnn_inv = np.empty((len(edges.node), 3, 3)), np.empty((n_nodes, 3, 3))
    bn, chi2 = np.empty((n_nodes, 3)), np.empty(len(edges.node))
    done, scale2 = 0, math.inf
    for done in range(1, iterations + 1):
        # The first pass with a large scale trusts every loop; only then is told who disagrees with the rest.
        _reduce(edges.submap, edges.T_submap_node, edges.information, edges.robust, first, pair_of, T_s, T_n,
                min(scale2, 1e12), 1e4, blocks, rhs, W, Hnn_inv, bn, chi2)  # fmt: skip
        settled = scale2 == final_scale2
        if math.isinf(scale2):
            scale2 = 4.0 * float(chi2[edges.robust].max()) if edges.robust.any() else final_scale2
        scale2 = max(scale2 / SHRINK, final_scale2)
        dx = _solve(blocks, row, col, rhs, fixed)
        _substitute(edges.submap, first, W, Hnn_inv, bn, dx, T_s, T_n)
        if settled and np.abs(dx).max() < 1e-5:
            break
    _reduce(edges.submap, edges.T_submap_node, edges.information, edges.robust, first, pair_of, T_s, T_n, final_scale2,
            1e4, blocks, rhs, W, Hnn_inv, bn, chi2)  # fmt: skip
    return GraphSolution(T_s, T_n, chi2, done)


def _solve(blocks: np.ndarray, row: np.ndarray, col: np.ndarray, rhs: np.ndarray, fixed: Sequence[int]) -> np.ndarray:
    n = len(rhs)
    diagonal = 1e-6 * np.ones(3 * n)
    for row_fixed in fixed:
        diagonal[3 * row_fixed : 3 * row_fixed + 3] = 1e12
    if n <= DENSE_SUBMAPS:
        A = np.zeros((n, 3, n, 3))
        A[row, :, col, :] = blocks
        A = A.reshape(3 * n, 3 * n)
        A[np.arange(3 * n), np.arange(3 * n)] += diagonal
        x = rhs.ravel().copy()
        if not cholesky_solve(A, x):
            raise FloatingPointError("the pose graph's normal equations are not positive definite")
        return x.reshape(n, 3)
    rows = np.repeat(3 * row[:, None] + np.arange(3), 3, axis=1).ravel()
    cols = np.tile(3 * col[:, None] + np.arange(3), (1, 3)).ravel()
    A = scipy.sparse.coo_matrix((blocks.ravel(), (rows, cols)), shape=(3 * n, 3 * n)).tocsc()
    A = A + scipy.sparse.diags(diagonal, format="csc")
    factor = scipy.sparse.linalg.splu(A, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    return factor.solve(rhs.ravel()).reshape(n, 3)
