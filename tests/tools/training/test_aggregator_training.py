"""Training of the aggregation: reproducible, resumable, and the same network in PyTorch and in ONNX."""

import json

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from beamsplat.common.errors import UserError
from beamsplat.services.fusion.fuse import Fusion
from beamsplat.services.fusion.inputs import FusionInput
from beamsplat.services.fusion.learned_aggregation import LearnedAggregation
from beamsplat.services.fusion.learned_inputs import LABELS
from beamsplat.tools.cli.main import app
from beamsplat.tools.training import optimisation
from beamsplat.tools.training.held_out import evaluate_held_out
from beamsplat.tools.training.network import (
    AggregationNetwork,
    ResidualBlock,
    aggregation_loss,
    decode,
    label_logits,
    soft_labels,
)
from beamsplat.tools.training.onnx_file import onnx_bytes
from beamsplat.tools.training.optimisation import OptimisationSettings, log_labels, mirrored, optimise
from beamsplat.tools.training.sample_files import load_sample, samples_in
from tests.services.fusion.room import CAMERA, T_BODY_CAMERA, in_map, render, scan
from tests.services.fusion.test_fuse import _path

LOG_Z = log_labels()
STEP = LOG_Z[1] - LOG_Z[0]


def _random_network():
    torch.manual_seed(5)
    network = AggregationNetwork()
    with torch.no_grad():
        for module in network.modules():
            if isinstance(module, ResidualBlock):
                module.second.weight.normal_(0.0, 0.02)
        network.leave.weight.normal_(0.0, 0.1)
    return network.eval()


def _tensors(inputs):
    arrays = (inputs.features(LOG_Z), inputs.cost, inputs.energy, inputs.place(LOG_Z))
    return [torch.from_numpy(array)[None] for array in arrays]


@pytest.fixture(scope="module")
def sample(samples):
    return load_sample(samples_in(samples[0], "robot")[1])


def test_the_network_fits_into_the_package():
    network = AggregationNetwork()
    assert len(onnx_bytes(network, {})) < 3_000_000


def test_training_starts_at_semi_global_matching(sample):
    features, cost, energy, place = _tensors(sample.inputs)
    with torch.no_grad():
        logits = label_logits(AggregationNetwork()(features), cost, energy, place)
    p = torch.softmax(logits, 1)[0].numpy()
    best = np.argmax(p, axis=0)
    np.testing.assert_array_equal(best, np.argmin(sample.inputs.energy, axis=2))


def test_onnx_and_kernels_give_what_pytorch_gives(sample, tmp_path):
    network = _random_network()
    path = tmp_path / "aggregator.onnx"
    path.write_bytes(onnx_bytes(network, {"seed": "5"}))
    depth, spread = LearnedAggregation(path).depth_of(sample.inputs, LOG_Z)
    features, cost, energy, place = _tensors(sample.inputs)
    with torch.no_grad():  # the file has weights of 16 bits
        network.load_state_dict({k: v.half().float() for k, v in network.state_dict().items()})
        expected, expected_spread = decode(
            label_logits(network(features), cost, energy, place), float(LOG_Z[0]), float(STEP)
        )
    difference = np.abs(np.log(depth / expected[0].numpy()))
    assert np.quantile(difference, 0.999) < 1e-4  # the median label may flip between equal probabilities
    assert np.quantile(np.abs(spread - expected_spread[0].numpy()), 0.999) < 1e-3


def test_the_same_network_gives_the_same_file():
    assert onnx_bytes(_random_network(), {}) == onnx_bytes(_random_network(), {})


def test_the_loss_is_least_at_the_true_depth():
    truth = torch.full((1, 4, 2, 3), 2.0)
    truth[:, :, 0, 0] = 0.0
    labels, weight = soft_labels(truth, float(LOG_Z[0]), float(STEP))
    assert weight[0, 0, 0] == 0.0
    assert weight.sum() == 5.0
    place = (np.log(2.0) - LOG_Z[0]) / STEP
    torch.testing.assert_close(labels.sum(1)[weight > 0], torch.ones(5))
    mean = (labels[0, :, 1, 1] * torch.arange(LABELS)).sum()
    assert float(mean) == pytest.approx(place, abs=1e-3)
    right, _ = aggregation_loss(torch.log(labels + 1e-6), labels, weight)
    shifted, _ = aggregation_loss(torch.log(labels.roll(3, 1) + 1e-6), labels, weight)
    farther, _ = aggregation_loss(torch.log(labels.roll(9, 1) + 1e-6), labels, weight)
    assert right < shifted < farther


def test_mirrored_inputs_are_those_of_the_mirrored_image(sample):
    twice = mirrored(mirrored(sample.inputs))
    np.testing.assert_array_equal(twice.cost, sample.inputs.cost)
    once = mirrored(sample.inputs).features(LOG_Z)[:, :120, :160]
    np.testing.assert_array_equal(once, sample.inputs.features(LOG_Z)[:, :120, :160][:, :, ::-1])


def _train(samples, folder, stop_at=None):
    files = [samples_in(samples[0], carrier) for carrier in ("robot", "hand")]
    folder.mkdir(exist_ok=True)

    def progress(done, total, loss):
        if done == stop_at:
            raise KeyboardInterrupt

    settings = OptimisationSettings(seed=3, steps=3, batch=2, threads=1)
    return optimise(*files, settings, folder / "checkpoint.pt", "cpu", progress)


def test_the_same_seed_gives_the_same_weights_also_after_an_interruption(samples, tmp_path, monkeypatch):
    monkeypatch.setattr(optimisation, "_CHECKPOINT_STEPS", 1)
    first = onnx_bytes(_train(samples, tmp_path / "first"), {})
    with pytest.raises(KeyboardInterrupt):
        _train(samples, tmp_path / "second", stop_at=2)
    assert onnx_bytes(_train(samples, tmp_path / "second"), {}) == first
    log = [json.loads(line) for line in (tmp_path / "first" / "log.jsonl").read_text().splitlines()]
    assert log[-1]["step"] == 3
    assert 0.0 < log[-1]["cross_entropy"] < 10.0


def test_damaged_files_are_named(samples, tmp_path):
    file = tmp_path / "robot_000.npz.zst"
    file.write_bytes(samples_in(samples[0], "robot")[0].read_bytes()[:5000])
    with pytest.raises(UserError, match=r"robot_000.npz.zst: not a complete training sample"):
        load_sample(file)
    (tmp_path / "checkpoint.pt").write_bytes(b"no checkpoint")
    with pytest.raises(UserError, match=r"checkpoint.pt: damaged"):
        _train(samples, tmp_path)


def test_held_out_errors_of_the_untrained_network_are_those_of_matching(samples, tmp_path):
    path = tmp_path / "aggregator.onnx"
    path.write_bytes(onnx_bytes(AggregationNetwork(), {}))
    report = evaluate_held_out(path, samples[0], lambda done, total: None)
    for carrier in ("robot", "hand"):
        comparison = report[carrier]["comparison"]
        assert report[carrier]["samples"] == 2
        assert comparison["absrel"]["first"] < 0.3
        assert abs(comparison["within_5cm"]["change"]) < 0.15
    assert report["cpu_ms"] > 0.0


def test_fusion_with_the_untrained_network_finds_the_depth_of_a_room(tmp_path):
    path = tmp_path / "aggregator.onnx"
    path.write_bytes(onnx_bytes(AggregationNetwork(), {}))
    learned = LearnedAggregation(path)
    fusion = Fusion(CAMERA, T_BODY_CAMERA, floor_known=True, planar=True, aggregation=learned)
    for k in range(8):
        T = _path(k)
        image, truth = render(T)
        beams = scan(T, np.random.default_rng(k))
        fusion.add_scan(in_map(T, beams))
        result = fusion.fuse(FusionInput(k, image, T, beams), keyframe=k % 2 == 0 or k == 7)
    assert result.ok
    error = np.abs(result.depth_m - truth)
    known = np.isfinite(error)
    assert known.mean() > 0.9
    assert np.median(error[known]) < 0.03
    assert np.mean(error[known] < 3.0 * result.sigma_m[known]) > 0.9
    hand = Fusion(CAMERA, T_BODY_CAMERA, floor_known=False, planar=False, aggregation=learned)
    assert hand._sweep.config.labels == LABELS


def _run(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_samples_of_other_settings_are_not_mixed(tmp_path):
    before = {"format": 1, "seed": 7, "samples": 40, "source": "", "source_options": {}}
    (tmp_path / "settings.json").write_text(json.dumps(before))
    result = _run("train", "aggregator", "--out", tmp_path, "--seed", 8)
    assert isinstance(result.exception, UserError)
    assert "settings.json" in str(result.exception)
    assert "seed = 7, not 8" in str(result.exception)


@pytest.mark.slow
def test_a_tiny_training_runs_from_homes_to_a_report(tmp_path):
    arguments = (
        "train", "aggregator", "--out", tmp_path, "--homes", 1, "--heldout-homes", 1, "--samples", 2,
        "--passes", 2, "--batch", 2, "--threads", 1, "--jobs", 1, "--seed", 11, "--device", "cpu", "--json",
    )  # fmt: skip
    first = json.loads(_run(*arguments).stdout)
    assert first["homes"]["train"]["robot"] == 2
    assert first["steps"] == first["steps_of_this_call"] == 4
    assert first["weights_bytes"] < 3_000_000
    assert first["heldout"]["hand"]["samples"] > 0
    (tmp_path / "checkpoint.pt").unlink()
    again = json.loads(_run(*arguments).stdout)
    assert again["weights_sha256"] == first["weights_sha256"]
