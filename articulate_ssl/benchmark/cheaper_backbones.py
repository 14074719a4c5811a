"""The separable and the direction convolution against their twins, and backbones of them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from articulate_ssl.benchmark.machine import Machine
from articulate_ssl.benchmark.result import Result
from articulate_ssl.benchmark.workload import forward_backward, ratios_and_seconds
from articulate_ssl.network.backbone import EquivariantBackbone
from articulate_ssl.ops import reference
from articulate_ssl.ops.direction_convolution import direction_convolution
from articulate_ssl.ops.neighborhood import Neighborhood
from articulate_ssl.ops.separable_group_convolution import separable_group_convolution

# By option of the backbone: the layer's convolution, its twin, and the buffer of the layer that the convolution reads.
KINDS = {
    "separable": (separable_group_convolution, reference.separable_group_convolution, "permutation"),
    "directions": (direction_convolution, reference.direction_convolution, "orbit"),
}


def cheaper_backbones(machine: Machine, points: Tensor, features: Tensor, neighborhood: Neighborhood) -> list[Result]:
    """Layers 64 -> 128 of the cheaper kinds against their twins, and backbones of such layers.

    Args:
        machine: where to measure.
        points: [B, N, 3], input of the backbones.
        features: [B, N, G, 64] without gradient, input of the layers.
        neighborhood: of the points, for the layers.
    """
    results = []
    for name, (function, twin, table) in KINDS.items():
        backbone = EquivariantBackbone(**{name: True}).to(machine.device)
        block = backbone.blocks[1]
        indexed = features[:, :, : len(getattr(block, table))].requires_grad_()  # by group elements or directions
        arguments = (indexed, neighborhood, block.spatial, block.mixing, getattr(block, table))
        results += _layer(machine, name, function, twin, arguments)
        results += _backbone(machine, name, backbone, points)
    return results


def _layer(machine: Machine, name: str, function: Callable, twin: Callable, arguments: tuple) -> list[Result]:
    def fast() -> Tensor:
        with machine.autocast():
            return function(*arguments)

    slow = forward_backward(lambda: twin(*arguments))
    ratios, seconds = ratios_and_seconds(machine, slow, forward_backward(fast), 5)
    return [
        Result(None, f"{name}: convolution 64 -> 128, forward + backward", ratios, "x"),
        Result(None, "  ours", seconds, "s"),
    ]


def _backbone(machine: Machine, name: str, backbone: EquivariantBackbone, points: Tensor) -> list[Result]:
    def forward() -> Tensor:
        with machine.autocast():
            return backbone(points)

    run = forward_backward(forward)
    memory = machine.peak_bytes(run)
    whole = [machine.seconds(run) for _ in range(3)]
    with torch.no_grad():
        once = [machine.seconds(forward) for _ in range(3)]
    return [
        Result(None, f"{name}: backbone, forward", once, "s"),
        Result(None, "  forward + backward", whole, "s"),
        Result(None, "  peak memory", [memory / 1e9], "GB"),
    ]
