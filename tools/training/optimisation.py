"""Training of the aggregation network: reproducible, and resumable at its checkpoints.

Which samples a step uses, and how they are changed, follows from the seed and the number of the step alone.
So a run that was interrupted ends with the same weights as one that was not.
"""

from __future__ import annotations

import io
import json
import pickle
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from beamsplat.common.errors import UserError
from beamsplat.common.files.persist import write_atomically
from beamsplat.services.fusion.inputs import PlaneSweepConfig
from beamsplat.services.fusion.learned_inputs import CANDIDATES, LABELS, AggregatorInputs
from beamsplat.tools.training.network import AggregationNetwork, aggregation_loss, label_logits, soft_labels
from beamsplat.tools.training.sample_files import load_sample

_PEAK_RATE, _LEAST_RATE, _WARM_UP, _FLAT = 8e-4, 1e-6, 100, 0.3  # of AdamW; steps; share of all steps
_AVERAGING = 0.998  # of the moving average of the weights, which is the result
_MAX_GRADIENT = 1.0
_CHECKPOINT_STEPS, _LOG_STEPS = 200, 50
_PREFETCHED = 3  # batches


@dataclass(frozen=True)
class OptimisationSettings:
    """Everything but the samples that determines the weights."""

    seed: int
    steps: int
    batch: int = 4
    threads: int = 2  # of PyTorch; another number may round differently


def log_labels() -> np.ndarray:
    """Return the log depth of the labels, float64 [LABELS], of the default settings of the plane sweep."""
    c = PlaneSweepConfig()
    return np.linspace(np.log(c.z_near_m), np.log(c.z_far_m), LABELS)


Batch = tuple[torch.Tensor, ...]  # features, cost, energy, place, true depth


def optimise(
    robot: list[Path], hand: list[Path], settings: OptimisationSettings, checkpoint: Path, device: str,
    progress: Callable[[int, int, float], None],
) -> AggregationNetwork:  # fmt: skip
    """Train the network, or continue at a checkpoint; return it with averaged weights, on the CPU.

    Args:
        robot: files of the samples of robots.
        hand: files of hand-held samples; half of the samples of each batch are from each carrier.
        checkpoint: file of the state, replaced every 200 steps; a state of other settings or samples is not
            used. Beside it, `log.jsonl` lists the loss.
        device: of PyTorch: "cpu" or "cuda". The same weights again are guaranteed on "cpu" only.
        progress: receives the number of finished and of all steps, and the mean loss of the last steps.

    Raises:
        UserError: there are no samples, or a file of a sample is damaged.
    """
    if not robot or not hand:
        raise UserError("there are no training samples of both carriers: use more --homes or --samples")
    torch.set_num_threads(settings.threads)
    torch.use_deterministic_algorithms(True, warn_only=device != "cpu")
    torch.manual_seed(settings.seed)
    network = AggregationNetwork().to(device)
    optimiser = torch.optim.AdamW(network.parameters(), lr=_PEAK_RATE, weight_decay=1e-4, betas=(0.9, 0.98))
    average = {name: value.clone() for name, value in network.state_dict().items()}
    identity = json.dumps([asdict(settings), [f"{p.parent.name}/{p.name}" for p in (*robot, *hand)]])
    first = _restore(checkpoint, identity, network, optimiser, average)
    losses: deque[float] = deque(maxlen=_LOG_STEPS)
    progress(first, settings.steps, float("nan"))
    for step, batch in _batches(robot, hand, settings, first):
        loss = _step(network, optimiser, [tensor.to(device) for tensor in batch], step, settings.steps)
        losses.append(loss)
        keep = min(_AVERAGING, (step + 1) / (step + 11))
        for name, value in network.state_dict().items():
            average[name].mul_(keep).add_(value, alpha=1.0 - keep)
        done = step + 1
        if done % _CHECKPOINT_STEPS == 0 or done == settings.steps:
            _store(checkpoint, identity, done, network, optimiser, average)
        if done % _LOG_STEPS == 0 or done == settings.steps:
            mean = float(np.mean(losses))
            with (checkpoint.parent / "log.jsonl").open("a") as log:
                log.write(json.dumps({"step": done, "cross_entropy": mean, "time_s": time.time()}) + "\n")
        progress(done, settings.steps, float(np.mean(losses)))
    network.load_state_dict(average)
    return network.to("cpu").eval()


def _step(
    network: AggregationNetwork, optimiser: torch.optim.Optimizer, batch: list[torch.Tensor], step: int,
    steps: int,
) -> float:  # fmt: skip
    """Do one step of gradient descent; return the cross entropy of its batch."""
    features, cost, energy, place, truth = batch
    log_z = log_labels()
    for group in optimiser.param_groups:
        group["lr"] = learning_rate(step, steps)
    labels, weight = soft_labels(truth, float(log_z[0]), float(log_z[1] - log_z[0]))
    loss, cross = aggregation_loss(label_logits(network(features), cost, energy, place), labels, weight)
    optimiser.zero_grad()
    loss.backward()
    torch.nn.utils.clip_grad_norm_(network.parameters(), _MAX_GRADIENT)
    optimiser.step()
    return float(cross.detach())


def learning_rate(step: int, steps: int) -> float:
    """Return the rate of a step: rising, then constant, then falling with a cosine to almost 0."""
    warm = min(1.0, (step + 1) / max(1, min(_WARM_UP, steps // 10)))
    share = step / max(steps, 1)
    fall = 1.0 if share < _FLAT else 0.5 * (1.0 + np.cos(np.pi * (share - _FLAT) / (1.0 - _FLAT)))
    return float(_PEAK_RATE * warm * fall + _LEAST_RATE)


def _batches(
    robot: list[Path], hand: list[Path], settings: OptimisationSettings, first: int
) -> Iterator[tuple[int, Batch]]:
    """Yield the step and its batch, from step `first`; later batches are loaded in threads meanwhile."""
    with ThreadPoolExecutor(max_workers=settings.batch) as pool:
        waiting: deque[list[Future[Batch]]] = deque()

        def request(step: int) -> None:
            numbers = range(step * settings.batch, (step + 1) * settings.batch)
            waiting.append([pool.submit(_prepared, robot, hand, settings.seed, n) for n in numbers])

        for step in range(first, min(first + _PREFETCHED, settings.steps)):
            request(step)
        for step in range(first, settings.steps):
            samples = [future.result() for future in waiting.popleft()]
            if step + _PREFETCHED < settings.steps:
                request(step + _PREFETCHED)
            yield step, tuple(torch.stack(parts) for parts in zip(*samples))


def _prepared(robot: list[Path], hand: list[Path], seed: int, number: int) -> Batch:
    """Return sample `number` of the whole training: of a robot and hand-held in turn, in random order."""
    files, count = (robot, hand)[number % 2], number // 2
    order = np.random.default_rng([seed, number % 2, count // len(files)]).permutation(len(files))
    rng = np.random.default_rng([seed, 2, number])
    sample = load_sample(files[order[count % len(files)]])
    mirror = rng.random() < 0.5
    inputs = augmented(sample.inputs, rng)
    h, w = inputs.votes.shape
    quarters = sample.truth_mm.reshape(h, 2, w, 2).transpose(1, 3, 0, 2).reshape(4, h, w)
    truth = quarters.astype(np.float32) * np.float32(1e-3)
    if mirror:
        inputs, truth = mirrored(inputs), truth[..., ::-1]
    log_z = log_labels()
    arrays = (inputs.features(log_z), inputs.cost, inputs.energy, inputs.place(log_z), truth)
    return tuple(torch.from_numpy(np.ascontiguousarray(array)) for array in arrays)


def mirrored(inputs: AggregatorInputs) -> AggregatorInputs:
    """Return the inputs of the image that is mirrored left to right."""
    columns = ("cost", "energy", "rgb", "lidar_plane_m", "votes", "rise", "spread")  # [h, w, ...]
    changed: dict[str, Any] = {n: np.ascontiguousarray(getattr(inputs, n)[:, ::-1]) for n in columns}
    return replace(inputs, **changed, log_depth=np.ascontiguousarray(inputs.log_depth[..., ::-1]))


def augmented(inputs: AggregatorInputs, rng: np.random.Generator) -> AggregatorInputs:
    """Return inputs with random changes: of colour, noise of the matching cost, missing candidates.

    The estimate of the depth source is left out in half of the cases, so that it stays optional.
    """
    log_depth = inputs.log_depth.copy()
    trust = inputs.trust
    if rng.random() < 0.5:
        log_depth[CANDIDATES.index("depth source")], trust = np.nan, 0.0
    if rng.random() < 0.1:
        log_depth[int(rng.integers(len(CANDIDATES)))] = np.nan
    cost = inputs.cost
    if rng.random() < 0.3:
        noise = rng.normal(0.0, rng.uniform(2.0, 16.0), cost.shape).astype(np.float32)
        cost = np.clip(cost + noise, 0.0, 255.0).astype(np.uint8)
    rise = inputs.rise if rng.random() < 0.85 else np.zeros_like(inputs.rise)
    return replace(
        inputs, log_depth=log_depth, trust=trust, cost=cost, rise=rise, rgb=_recoloured(inputs.rgb, rng)
    )


def _recoloured(rgb: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the image uint8 [h, w, 3] with other exposure, tint, contrast and noise; seldom grey or flat."""
    gain, tint = 2.0 ** rng.normal(0.0, 0.4), rng.normal(1.0, 0.06, 3)
    values = np.clip(rgb * (gain * tint / 255.0) + rng.normal(0.0, 0.025), 0.0, 1.0)
    values = 255.0 * values ** np.exp(rng.normal(0.0, 0.2))
    values += rng.normal(0.0, rng.uniform(0.0, 5.0), values.shape)
    kind = rng.random()
    if kind < 0.08:
        values[:] = 128.0
    elif kind < 0.2:
        values[:] = values.mean(axis=2, keepdims=True)
    return np.clip(values, 0.0, 255.0).astype(np.uint8)


def _store(
    path: Path, identity: str, step: int, network: AggregationNetwork, optimiser: torch.optim.Optimizer,
    average: dict[str, torch.Tensor],
) -> None:  # fmt: skip
    buffer = io.BytesIO()
    state = {
        "identity": identity, "step": step, "network": network.state_dict(),
        "optimiser": optimiser.state_dict(), "average": average,
    }  # fmt: skip
    torch.save(state, buffer)
    write_atomically(path, buffer.getvalue())


def _restore(
    path: Path, identity: str, network: AggregationNetwork, optimiser: torch.optim.Optimizer,
    average: dict[str, torch.Tensor],
) -> int:  # fmt: skip
    """Load the state of a checkpoint, if there is one of the same training; return the next step.

    Raises:
        UserError: the file is damaged.
    """
    if not path.is_file():
        return 0
    try:
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        if state["identity"] != identity:
            return 0
        network.load_state_dict(state["network"])
        optimiser.load_state_dict(state["optimiser"])
        for name, value in state["average"].items():
            average[name].copy_(value)
        return int(state["step"])
    except (RuntimeError, KeyError, EOFError, ValueError, OSError, pickle.UnpicklingError) as error:
        raise UserError(f"{path}: damaged ({error}): remove it, then training starts again") from error
