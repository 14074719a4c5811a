"""The two-layer perceptron that every head ends in."""

from __future__ import annotations

from torch import nn

_START_WEIGHT = 1e-3  # a new head says almost nothing: instances start as the category, poses as the group's elements


def perceptron(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Linear, LeakyReLU, linear, with small weights and no bias at the end."""
    layers = nn.Sequential(nn.Linear(inputs, hidden), nn.LeakyReLU(0.1), nn.Linear(hidden, outputs))
    nn.init.normal_(layers[-1].weight, std=_START_WEIGHT)
    nn.init.zeros_(layers[-1].bias)
    return layers
