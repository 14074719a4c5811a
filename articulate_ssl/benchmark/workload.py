"""What several measurements share: random clouds, forward + backward of a function, two functions timed in turn."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from articulate_ssl.benchmark.machine import Machine

EXTENT = 0.6  # side of the cube that random clouds fill: balls hold about as many points as on a real object's surface


def random_clouds(machine: Machine, batch: int, num_points: int) -> Tensor:
    """Points [B, N, 3] in a cube, the same in every call."""
    generator = torch.Generator().manual_seed(0)
    return (EXTENT * torch.rand(batch, num_points, 3, generator=generator)).to(machine.device)


def forward_backward(function: Callable[[], Tensor]) -> Callable[[], None]:
    """Backward from a gradient made once, so that no loss is measured with the function."""
    with torch.no_grad():
        direction = torch.randn_like(function())

    def run() -> None:
        out = function()
        out.backward(direction.to(out.dtype))

    return run


def ratios_and_seconds(
    machine: Machine, twin: Callable, fast: Callable, repeats: int
) -> tuple[list[float], list[float]]:
    """Ratios twin / fast of interleaved calls, and the seconds of the fast one; one call of the fast one warms up."""
    machine.seconds(fast)
    pairs = [(machine.seconds(twin), machine.seconds(fast)) for _ in range(repeats)]
    return [a / b for a, b in pairs], [b for _, b in pairs]
