"""Clouds that are kept with weights, in a byte a coordinate: points are farther apart than what that costs."""

from __future__ import annotations

import torch
from torch import Tensor

_STEPS = 127  # from the origin to the largest coordinate


def in_few_bytes(
    clouds: Tensor,  # [n, P, 3]
) -> tuple[Tensor, Tensor]:  # [n, P, 3] int8, [n] what one is
    """Round every cloud to steps of its own."""
    step = clouds.abs().amax(dim=(1, 2)).clamp(min=1e-9) / _STEPS
    return (clouds / step[:, None, None]).round().to(torch.int8), step


def from_few_bytes(
    rounded: Tensor,  # [n, P, 3] int8
    step: Tensor,  # [n]
) -> Tensor:  # [n, P, 3]
    """The clouds, to half a step."""
    return rounded * step[:, None, None]
