"""The learned aggregation: its kernels against plain versions, its weights file, and the options of the node."""

from pathlib import Path

import numpy as np
import pytest

from beamsplat.common.errors import UserError
from beamsplat.services.fusion.aggregation_choice import make_aggregation
from beamsplat.services.fusion.learned_inputs import (
    CANDIDATES,
    CHANNELS,
    INPUTS_VERSION,
    LABELS,
    MULTIPLE,
    OUTPUTS,
    SCALARS,
    AggregatorInputs,
)
from beamsplat.services.fusion.learned_kernels import (
    COST_STEP,
    ENERGY_STEP,
    decode_depth,
    quantised_cost,
    quantised_energy,
)
from beamsplat.services.fusion.node import FusionConfig, FusionNode

H, W, K = 5, 7, len(CANDIDATES)
LOG_Z = np.linspace(np.log(0.4), np.log(14.0), LABELS)


@pytest.fixture
def inputs():
    rng = np.random.default_rng(1)
    log_depth = rng.uniform(np.log(0.3), np.log(16.0), (K, H, W)).astype(np.float16)
    log_depth[rng.random((K, H, W)) < 0.3] = np.nan
    return AggregatorInputs(
        cost=rng.integers(0, 256, (H, W, LABELS)).astype(np.uint8),
        energy=rng.integers(0, 256, (H, W, LABELS)).astype(np.uint8), log_depth=log_depth,
        rgb=rng.integers(0, 256, (H, W, 3)).astype(np.uint8),
        lidar_plane_m=rng.uniform(0, 3, (H, W)).astype(np.float16),
        votes=rng.integers(0, 7, (H, W)).astype(np.uint8), rise=rng.normal(0, 0.3, (H, W)).astype(np.float16),
        spread=rng.uniform(0, 0.5, (H, W)).astype(np.float16), views=3, trust=0.4,
    )  # fmt: skip


def test_costs_are_quantised_to_the_nearest_step():
    cost = np.random.default_rng(2).uniform(-1.0, 10.0, (H, W, LABELS)).astype(np.float32)
    back = quantised_cost(cost) * COST_STEP
    np.testing.assert_allclose(back, np.clip(cost, 0.0, 8.0), atol=0.51 * COST_STEP)


def test_energies_are_relative_to_the_cheapest_label():
    total = np.random.default_rng(3).uniform(0.0, 80.0, (H, W, LABELS)).astype(np.float32)
    back = quantised_energy(total, 4.0) * ENERGY_STEP
    expected = np.minimum((total - total.min(axis=2, keepdims=True)) / 4.0, 12.75)
    np.testing.assert_allclose(back, expected, atol=0.51 * ENERGY_STEP)


def test_features_are_those_of_the_plain_version(inputs):
    out = inputs.features(LOG_Z)
    assert out.shape == (CHANNELS, MULTIPLE, MULTIPLE)
    assert not out[:, H:].any()
    assert not out[:, :, W:].any()
    out = out[:, :H, :W]
    cost = 0.25 * COST_STEP * inputs.cost.astype(np.float64) - 1.0
    np.testing.assert_allclose(out[:LABELS], cost.transpose(2, 0, 1), atol=1e-6)
    energy = np.exp(-0.25 * ENERGY_STEP * inputs.energy.astype(np.float64))
    np.testing.assert_allclose(out[LABELS : 2 * LABELS], energy.transpose(2, 0, 1), atol=1e-6)
    place = inputs.place(LOG_Z)
    assert np.isnan(place[np.isnan(inputs.log_depth)]).all()
    for k in range(K):
        for v in range(H):
            for u in range(W):
                at = place[k, v, u]
                position, exists, matched = out[2 * LABELS + k + K * np.arange(3), v, u]
                if np.isnan(at):
                    assert position == exists == matched == 0.0
                    continue
                assert 0.0 <= at <= LABELS - 1
                assert exists == 1.0
                assert position == pytest.approx(2.0 * at / LABELS - 1.0, abs=1e-5)
                assert matched == pytest.approx(np.interp(at, np.arange(LABELS), cost[v, u]), abs=1e-4)
    np.testing.assert_allclose(out[-SCALARS:], inputs.scalars())


def _decoded(output, inputs):
    depth = np.empty((H, W), np.float32)
    spread = np.empty_like(depth)
    step = LOG_Z[1] - LOG_Z[0]
    decode_depth(output, inputs.cost, inputs.energy, inputs.place(LOG_Z), LOG_Z[0], step, depth, spread)
    return depth, spread


def test_decoding_is_that_of_the_plain_version(inputs):
    output = np.random.default_rng(4).normal(0.0, 1.5, (OUTPUTS, MULTIPLE, MULTIPLE)).astype(np.float32)
    depth, spread = _decoded(output, inputs)
    place, labels = inputs.place(LOG_Z), np.arange(LABELS)
    step = LOG_Z[1] - LOG_Z[0]
    for v in range(H):
        for u in range(W):
            o = output[:, v, u].astype(np.float64)
            logit = (
                o[:LABELS] - o[-2] * ENERGY_STEP * inputs.energy[v, u] - o[-1] * COST_STEP * inputs.cost[v, u]
            )
            for k in np.flatnonzero(np.isfinite(place[:, v, u])):
                logit += o[LABELS + k] * np.maximum(1.0 - np.abs(labels - place[k, v, u]), 0.0)
            p = np.exp(logit - logit.max())
            p /= p.sum()
            median = int((np.cumsum(p) < 0.5).sum())
            near = np.abs(labels - median) <= 2
            centre = (p * labels)[near].sum() / p[near].sum()
            assert depth[v, u] == pytest.approx(np.exp(LOG_Z[0] + centre * step), rel=1e-4)
            expected = np.sqrt((p * (labels - centre) ** 2).sum()) * step
            assert spread[v, u] == pytest.approx(expected, rel=1e-3)


def test_a_gate_puts_the_depth_on_its_candidate(inputs):
    output = np.zeros((OUTPUTS, MULTIPLE, MULTIPLE), np.float32)
    output[LABELS + 2] = 60.0  # the floor
    depth, spread = _decoded(output, inputs)
    exists = np.isfinite(inputs.place(LOG_Z)[2])
    expected = np.exp(np.clip(inputs.log_depth[2].astype(np.float64), LOG_Z[0], LOG_Z[-1]))
    # Between two labels, the weights are those of a softmax: up to half a label of 5.6 % off.
    np.testing.assert_allclose(depth[exists], expected[exists], rtol=0.03)
    assert spread[exists].max() < 0.03


def _weights(path, version=INPUTS_VERSION, channels=CHANNELS):
    onnx = pytest.importorskip("onnx")
    from onnx import TensorProto, helper, numpy_helper

    weight = numpy_helper.from_array(np.zeros((OUTPUTS, channels, 1, 1), np.float32), "weight")
    graph = helper.make_graph(
        [helper.make_node("Conv", ["features", "weight"], ["output"])], "zero",
        [helper.make_tensor_value_info("features", TensorProto.FLOAT, [1, channels, "h", "w"])],
        [helper.make_tensor_value_info("output", TensorProto.FLOAT, [1, OUTPUTS, "h", "w"])], [weight],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    if version is not None:
        helper.set_model_props(model, {"beamsplat_aggregator_inputs": str(version)})
    onnx.save(model, str(path))
    return path


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"version": None}, "no network for aggregation"),
        ({"version": 99}, "version 99"),
        ({"channels": 5}, "expected \\[1"),
    ],
)
def test_a_file_with_another_network_is_refused(tmp_path, arguments, words):
    path = _weights(tmp_path / "other.onnx", **arguments)
    with pytest.raises(UserError, match=words) as refused:
        make_aggregation("learned", path, "field")
    assert str(path) in str(refused.value)
    assert "train aggregator" in str(refused.value)


def test_a_uniform_distribution_is_decoded_to_its_median(inputs, tmp_path):
    aggregation = make_aggregation("learned", _weights(tmp_path / "zero.onnx"), "field")
    depth, spread = aggregation.depth_of(inputs, LOG_Z)
    np.testing.assert_allclose(depth, np.exp(LOG_Z[LABELS // 2 - 1]), rtol=1e-4)
    np.testing.assert_allclose(spread, np.std(LOG_Z), rtol=1e-2)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "fusion.aggregation_weights is required"),
        ({"aggregation_weights": Path("no/such.onnx")}, "no/such.onnx: there is no such file"),
        ({"aggregation_weights": Path("no/such.onnx"), "method": "ratio"}, 'fusion.method = "ratio"'),
    ],
)
def test_the_node_refuses_options_that_do_not_fit(options, words):
    node = FusionNode(FusionConfig(aggregation="learned", **options))
    with pytest.raises(UserError, match=words):
        node.check_resources()
    with pytest.raises(UserError, match=words):
        node.configure()


def test_the_default_needs_no_weights():
    node = FusionNode(FusionConfig())
    node.check_resources()
    node.configure()
