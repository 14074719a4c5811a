"""Clouds spread evenly over what each of them could be, so that no hypothesis dies for want of clouds."""

from __future__ import annotations

import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor


def balanced_assignment(
    cost: Tensor,  # [B, A]
) -> Tensor:  # [B] int64
    """Of every cloud one of A choices, each at most ceil(B / A) times, so that the total cost is least."""
    clouds, choices = cost.shape
    places = cost.repeat(1, -(-clouds // choices))
    chosen = linear_sum_assignment(places.cpu().numpy())[1]
    return torch.as_tensor(chosen % choices, dtype=torch.int64, device=cost.device)
