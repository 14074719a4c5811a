"""A fast operation against its readable twin."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-9}


def relative_error(a: Tensor, b: Tensor) -> float:
    """Norm of the difference over the norm of b."""
    return ((a - b).norm() / b.norm()).item()


def assert_same_as_twin(
    fast: Callable[[], Tensor], twin: Callable[[], Tensor], inputs: Sequence[Tensor], tolerance: float
) -> None:
    """Values, and gradients to the inputs, agree."""
    results = []
    for function in (fast, twin):
        out = function()
        direction = torch.linspace(-1, 1, out.numel(), dtype=out.dtype, device=out.device).view_as(out)
        results.append((out, *torch.autograd.grad(out, inputs, direction)))
    for a, b in zip(*results, strict=True):
        assert relative_error(a, b) < tolerance
