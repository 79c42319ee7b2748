import numpy as np
import scipy.optimize

from beamsplat.services.localization.lidar2d import graph_optimisation, se2
from beamsplat.services.localization.lidar2d.graph_optimisation import ConstraintArrays, optimise
from beamsplat.services.localization.lidar2d.pose_graph_data import edge_information


def problem(rng, n_submaps=6, n_nodes=40, noise=0.01):
    """Return submaps along a ring and nodes near them; each node is in two submaps, the last closes the ring."""
    angle = np.linspace(0, 1.8 * np.pi, n_submaps)
    submaps = np.column_stack([5 * np.cos(angle), 5 * np.sin(angle), se2.wrap_many(angle)])
    nodes, submap, node, z, info = [], [], [], [], []
    for n in range(n_nodes):
        s = n * (n_submaps - 1) // n_nodes
        pose = se2.compose(submaps[s], np.array([*rng.uniform(-1, 1, 2), rng.uniform(-1, 1)]))
        nodes.append(pose)
        for k in (s, s + 1) if n < n_nodes - 3 else (s, s + 1, 0):
            submap.append(k)
            node.append(n)
            z.append(se2.between(submaps[k], pose) + noise * rng.standard_normal(3))
            A = rng.normal(size=(3, 3))
            info.append(np.diag([1e4, 1e4, 4e4]) + 1e3 * A @ A.T)
    edges = ConstraintArrays(
        np.array(submap, np.int32),
        np.array(node, np.int32),
        np.array(z),
        np.array(info),
        np.zeros(len(z), dtype=bool),
    )
    return submaps, np.array(nodes), edges


def test_solution_against_scipy(rng):
    submaps, nodes, edges = problem(rng, noise=0.001)
    start_s, start_n = (
        submaps + 0.05 * rng.standard_normal(submaps.shape),
        nodes + 0.05 * rng.standard_normal(nodes.shape),
    )
    start_s[0] = submaps[0]
    solution = optimise(start_s, start_n, edges, iterations=25)
    roots = np.linalg.cholesky(edges.information)

    def residuals(x):
        s, n = (
            np.vstack([submaps[:1], x[: 3 * (len(submaps) - 1)].reshape(-1, 3)]),
            x[3 * (len(submaps) - 1) :].reshape(-1, 3),
        )
        e = se2.between_many(s[edges.submap], n[edges.node]) - edges.pose_submap_node
        e[:, 2] = se2.wrap_many(e[:, 2])
        return np.einsum("nji,nj->ni", roots, e).ravel()

    best = scipy.optimize.least_squares(
        residuals, np.concatenate([start_s[1:].ravel(), start_n.ravel()]), xtol=1e-12
    )
    assert np.allclose(solution.pose_map_submap[1:].ravel(), best.x[: 3 * (len(submaps) - 1)], atol=2e-4)
    assert (
        np.abs(
            se2.between_many(solution.pose_map_node, best.x[3 * (len(submaps) - 1) :].reshape(-1, 3))
        ).max()
        < 2e-4
    )


def test_sparse_and_dense_agree(rng, monkeypatch):
    submaps, nodes, edges = problem(rng)
    dense = optimise(submaps, nodes, edges)
    monkeypatch.setattr(graph_optimisation, "DENSE_SUBMAPS", 0)
    sparse = optimise(submaps, nodes, edges)
    assert np.allclose(dense.pose_map_submap, sparse.pose_map_submap, atol=1e-7)


def test_a_wrong_loop_closure_is_rejected_and_true_ones_correct_the_drift(rng):
    submaps, nodes, edges = problem(rng, noise=0.0)
    n = len(edges.node)
    # Three loop closures at the end are right, a fourth is wrong by two metres.
    robust = np.zeros(n, dtype=bool)
    robust[edges.submap == 0] = edges.node[edges.submap == 0] >= 37
    z = edges.pose_submap_node.copy()
    wrong_edge = np.flatnonzero(robust)[0]
    extra = ConstraintArrays(
        np.append(edges.submap, 0).astype(np.int32),
        np.append(edges.node, edges.node[wrong_edge]).astype(np.int32),
        np.vstack([z, z[wrong_edge] + [2.0, 0, 0]]),
        np.concatenate([edges.information, edges.information[wrong_edge][None]]),
        np.append(robust, True),
    )
    order = np.argsort(extra.node, kind="stable")
    extra = ConstraintArrays(
        *(getattr(extra, f)[order] for f in ("submap", "node", "pose_submap_node", "information", "robust"))
    )
    solution = optimise(submaps, nodes, extra)
    assert np.abs(se2.between_many(solution.pose_map_node, nodes)[:, :2]).max() < 0.01
    wrong = np.flatnonzero(
        np.abs(
            extra.pose_submap_node[:, 0] - se2.between_many(submaps[extra.submap], nodes[extra.node])[:, 0]
        )
        > 1
    )
    assert solution.chi2[wrong].min() > 1000


def test_fixed_submaps_stay(rng):
    submaps, nodes, edges = problem(rng, noise=0.05)
    solution = optimise(submaps, nodes, edges, fixed=[0, 3])
    assert np.allclose(solution.pose_map_submap[[0, 3]], submaps[[0, 3]], atol=1e-6)
    assert not np.allclose(solution.pose_map_submap[1], submaps[1], atol=1e-4)


def test_edge_information_is_limited():
    certain = np.linalg.inv(edge_information(np.diag([1e9, 1e9, 1e9]), 0.01, 0.002))
    assert np.allclose(np.sqrt(np.diag(certain)), [0.01, 0.01, 0.002], rtol=1e-3)
    blind = np.linalg.inv(edge_information(np.zeros((3, 3)), 0.01, 0.002))
    assert np.all(np.isfinite(blind))
    assert np.sqrt(blind[0, 0]) > 1.0
