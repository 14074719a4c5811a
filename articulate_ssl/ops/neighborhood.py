"""Neighbourhoods of a point cloud and the kernel correlation of every neighbour: the geometry of a convolution."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

KERNEL_RADIUS = 0.7  # kernel points lie within this fraction of the ball's radius
INFLUENCE = 0.5  # sigma / radius^2, the squared distance at which a kernel point's influence ends


class Neighbors(NamedTuple):
    """Nearest neighbours of M centres; radius-free, so that layers of any radius share one search.

    Attributes:
        index: [B, M, n] int64, nearest first.
        offset: [B, M, n, 3] x_j - x_i.
        centers: [B, M] int64 indices of the centres, or None where every point is one (M = N).
    """

    index: Tensor
    offset: Tensor
    centers: Tensor | None


class Neighborhood(NamedTuple):
    """Neighbours within a ball and their correlation with every kernel point.

    Attributes:
        index: [B, M, n] int64 into the N points; slots outside the ball hold a valid index and zero weight.
        weight: [B, M, K, n] max(0, 1 - |d - kappa_k|^2 / sigma), divided by the number of neighbours in the ball.
        num_points: N.
        centers: [B, M] int64, or None where every point is a centre (M = N).
    """

    index: Tensor
    weight: Tensor
    num_points: int
    centers: Tensor | None


@torch.no_grad()
def nearest_neighbors(
    points: Tensor,  # [B, N, 3]
    num_neighbors: int,
    centers: Tensor | None = None,  # [B, M] int64
) -> Neighbors:
    """The `num_neighbors` nearest points (at most N) of every centre, the centre itself included."""
    queries = points if centers is None else points.gather(1, centers[..., None].expand(-1, -1, 3))
    count = min(num_neighbors, points.shape[1])
    # Differences, not the expanded square: exact for coincident points and unmoved by translation far from the origin.
    distance = torch.cdist(queries, points, compute_mode="donot_use_mm_for_euclid_dist")
    index = distance.topk(count, dim=-1, largest=False).indices  # [B, M, n]
    neighbor = points.gather(1, index.flatten(1)[..., None].expand(-1, -1, 3)).unflatten(1, index.shape[1:])
    return Neighbors(index, neighbor - queries[:, :, None], centers)


@torch.no_grad()
def correlate(
    neighbors: Neighbors,
    radius: float,
    kernel_points: Tensor,  # [K, 3] unit scale
    num_points: int,
) -> Neighborhood:
    """Correlation weights of the neighbours inside the ball.

    The original fills a ball's missing slots by repeating the found neighbours, so that every point sums n entries;
    dividing by the number of neighbours found is the same normalisation without the repetition.
    """
    offset = neighbors.offset
    kernel = kernel_points.to(offset) * (KERNEL_RADIUS * radius)
    square = offset.square().sum(dim=-1)  # [B, M, n]
    inside = square <= radius**2
    # |d - kappa|^2 / sigma, from the scale-free product to keep float32 accuracy
    cross = torch.einsum("kc,bmnc->bmkn", kernel, offset)
    distance = square[:, :, None] + kernel.square().sum(dim=-1)[:, None] - 2 * cross  # [B, M, K, n]
    weight = (1 - distance / (INFLUENCE * radius**2)).clamp_(min=0)
    weight *= (inside / inside.sum(dim=-1, keepdim=True).clamp(min=1))[:, :, None]
    return Neighborhood(neighbors.index, weight, num_points, neighbors.centers)


def build_neighborhood(
    points: Tensor,  # [B, N, 3]
    radius: float,
    kernel_points: Tensor,  # [K, 3] unit scale
    num_neighbors: int,
    centers: Tensor | None = None,  # [B, M] int64
) -> Neighborhood:
    """Neighbourhoods of radius `radius`, the nearest `num_neighbors` points at most, with their kernel correlation.

    Geometry is constant to the convolution: no gradient reaches `points`.

    Raises:
        ValueError: if `points` is not [B, N, 3] with N >= 1, or `centers` not [B, M].
    """
    if points.ndim != 3 or points.shape[-1] != 3 or points.shape[1] == 0:
        raise ValueError(f"points must be [B, N, 3] with at least one point, got {list(points.shape)}")
    if centers is not None and (centers.ndim != 2 or centers.shape[0] != points.shape[0]):
        raise ValueError(f"centers must be [{points.shape[0]}, M] indices of points, got {list(centers.shape)}")
    return correlate(nearest_neighbors(points, num_neighbors, centers), radius, kernel_points, points.shape[1])
