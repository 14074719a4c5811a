"""Readable twins of the fast operators, computed as the original implementation does. For tests and benchmarks."""

from __future__ import annotations

import torch
from torch import Tensor

from articulate_ssl.ops.neighborhood import Neighborhood


def group_convolution(
    features: Tensor | None,  # [B, N, G, C], or None for the constant one with C = 1
    neighborhood: Neighborhood,
    weight: Tensor,  # [K, C, C']
    permutation: Tensor,  # [G, K]
) -> Tensor:  # [B, M, G, C']
    """Group convolution with a correlation weight per neighbour, kernel point and group element, in plain autograd."""
    index, correlation = neighborhood.index, neighborhood.weight
    if features is None:
        features = weight.new_ones(index.shape[0], neighborhood.num_points, permutation.shape[0], 1)
    rotated = correlation[..., permutation]  # [B, M, n, G, K]: entry (g, k) belongs to kernel point A_g kappa_k
    sample = torch.arange(index.shape[0], device=index.device)[:, None, None]
    grouped = features[sample, index]  # [B, M, n, G, C]
    aggregate = torch.einsum("bmngk,bmngc->bmgkc", rotated, grouped)
    return torch.einsum("bmgkc,kcd->bmgd", aggregate, weight)


def chamfer(
    points: Tensor,  # [*, N, 3]
    target: Tensor,  # [*, M, 3]
    squared: bool = False,
    bidirectional: bool = True,
    weight: Tensor | None = None,  # [*, N]
) -> Tensor:  # [*]
    """Chamfer distance with the whole distance matrix under autograd."""
    distance = torch.cdist(points, target, compute_mode="donot_use_mm_for_euclid_dist")
    if squared:
        distance = distance.square()
    forward = distance.amin(dim=-1)
    if weight is None:
        weight = torch.ones_like(forward)
    result = (weight * forward).sum(dim=-1) / weight.sum(dim=-1)
    return result + distance.amin(dim=-2).mean(dim=-1) if bidirectional else result
