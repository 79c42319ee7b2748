"""The aggregation network in PyTorch, its loss, and the plain version of its decoding.

A U-Net of residual 3x3 convolutions corrects the label distribution of semi-global matching: it yields a
residual per label, a gate per candidate surface that adds to the two nearest labels, and gains of the energy
and of the matching cost. The last layer starts at zero, so training starts at semi-global matching.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import nn
from torch.nn import functional

from beamsplat.services.fusion.learned_inputs import CANDIDATES, CHANNELS, LABELS, OUTPUTS
from beamsplat.services.fusion.learned_kernels import COST_STEP, ENERGY_STEP

WIDTHS = (24, 32, 64, 96, 112)  # channels at 1, 1/2, 1/4, 1/8 and 1/16 of the working size
_REACH = 2  # labels on each side of the median, as in `learned_kernels`
_EMD_WEIGHT = 0.1  # of the earth mover's distance, in labels, beside the cross entropy


class ResidualBlock(nn.Module):
    """x + conv(relu(conv(relu(x)))), which starts as the identity."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)
        nn.init.zeros_(self.second.weight)
        _zero_bias(self.second)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return a tensor of the shape of x [B, C, h, w]."""
        return x + self.second(functional.relu(self.first(functional.relu(x))))


class AggregationNetwork(nn.Module):
    """Input [B, CHANNELS, h, w] of `AggregatorInputs.features`, output [B, OUTPUTS, h, w] of `decode_depth`.

    h and w must be multiples of `learned_inputs.MULTIPLE`.
    """

    def __init__(self, widths: tuple[int, ...] = WIDTHS) -> None:
        super().__init__()
        self.enter = nn.Conv2d(CHANNELS, widths[0], 1)
        self.local = nn.Conv2d(widths[0], widths[0], 3, padding=1)
        pairs = list(pairwise(widths))
        self.down = nn.ModuleList(nn.Conv2d(a, b, 3, stride=2, padding=1) for a, b in pairs)
        self.inner = nn.ModuleList(ResidualBlock(b) for b in widths[1:])
        self.bottom = ResidualBlock(widths[-1])
        self.up = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in reversed(pairs))
        self.outer = nn.ModuleList(ResidualBlock(a) for a in widths[-2:0:-1])
        self.last = nn.Conv2d(widths[0], widths[0], 3, padding=1)
        self.leave = nn.Conv2d(widths[0], OUTPUTS, 1)
        nn.init.zeros_(self.leave.weight)
        _zero_bias(self.leave)
        with torch.no_grad():
            assert self.leave.bias is not None
            self.leave.bias[LABELS + len(CANDIDATES)] = 1.0  # gain of the energy

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Return the network output."""
        x = self.enter(features)
        x = x + self.local(functional.relu(x))
        skipped = [x]
        for down, inner in zip(self.down, self.inner):
            x = inner(down(functional.relu(x)))
            skipped.append(x)
        x = self.bottom(skipped.pop())
        for k, up in enumerate(self.up):
            smaller = up(functional.relu(x))
            x = skipped.pop() + functional.interpolate(smaller, scale_factor=2.0, mode="nearest")
            if k < len(self.outer):
                x = self.outer[k](x)
        x = x + self.last(functional.relu(x))
        return self.leave(functional.relu(x))


def _zero_bias(conv: nn.Conv2d) -> None:
    if conv.bias is not None:
        nn.init.zeros_(conv.bias)


def label_logits(
    output: torch.Tensor,  # [B, OUTPUTS, H, W], H >= h, W >= w
    cost: torch.Tensor,  # uint8 [B, h, w, LABELS]
    energy: torch.Tensor,  # uint8 [B, h, w, LABELS]
    place: torch.Tensor,  # float32 [B, K, h, w], NaN = none
) -> torch.Tensor:
    """Return the logits of the labels [B, LABELS, h, w], as in `learned_kernels.decode_depth`."""
    h, w = cost.shape[1:3]
    output = output[:, :, :h, :w]
    gates, gains = output[:, LABELS:-2], output[:, -2:]
    logits = output[:, :LABELS] - gains[:, :1] * _labels_first(energy, ENERGY_STEP)
    logits = logits - gains[:, 1:] * _labels_first(cost, COST_STEP)
    exists = torch.isfinite(place)
    at = torch.where(exists, place, torch.zeros_like(place))
    first = at.floor().clamp(0, LABELS - 2)
    a = at - first
    gates = gates * exists
    index = first.long()
    return logits.scatter_add(1, index, gates * (1.0 - a)).scatter_add(1, index + 1, gates * a)


def _labels_first(volume: torch.Tensor, step: float) -> torch.Tensor:
    return volume.permute(0, 3, 1, 2).float() * step


def decode(logits: torch.Tensor, log_z0: float, log_step: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Return depth (m) and spread (log depth), [B, h, w] each: the plain version of `decode_depth`."""
    p = torch.softmax(logits.double(), 1)
    labels = torch.arange(LABELS, dtype=p.dtype, device=p.device).view(1, -1, 1, 1)
    median = (torch.cumsum(p, 1) < 0.5).sum(1, keepdim=True).clamp(0, LABELS - 1)
    near = p * ((labels - median).abs() <= _REACH)
    centre = (near * labels).sum(1, keepdim=True) / near.sum(1, keepdim=True)
    variance = (p * (labels - centre) ** 2).sum(1)
    return torch.exp(log_z0 + centre[:, 0] * log_step), torch.sqrt(variance) * log_step


def soft_labels(
    truth_m: torch.Tensor,  # float32 [B, 4, h, w], true depth at the four image pixels of each, 0 = none
    log_z0: float,
    log_step: float,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the distribution of true depth over labels [B, LABELS, h, w], and its weight [B, h, w].

    The weight is 1 where at least two of the four true depths are known, else 0.
    """
    known = ((truth_m > 0.25) & (truth_m < 20.0)).float()
    place = ((torch.log(truth_m.clamp_min(0.05)) - log_z0) / log_step).clamp(0.0, LABELS - 1.001)
    first = place.floor()
    a = (place - first) * known
    index = first.long()
    b, _, h, w = truth_m.shape
    labels = torch.zeros(b, LABELS, h, w, device=truth_m.device)
    labels.scatter_add_(1, index, known - a).scatter_add_(1, index + 1, a)
    count = known.sum(1)
    return labels / count.clamp_min(1.0)[:, None], (count >= 2).float()


def aggregation_loss(
    logits: torch.Tensor, labels: torch.Tensor, weight: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the loss to minimise, and its cross entropy alone, both means over pixels with weight.

    The loss is the cross entropy plus 0.1 times the earth mover's distance in labels.
    """
    log_p = torch.log_softmax(logits, 1)
    entropy = -(labels * log_p).sum(1)
    distance = torch.cumsum(log_p.exp() - labels, 1).abs().sum(1)
    count = weight.sum().clamp_min(1.0)
    cross = (entropy * weight).sum() / count
    return cross + _EMD_WEIGHT * (distance * weight).sum() / count, cross
