"""Neighbourhoods of a point cloud and the kernel correlation of every neighbour: the geometry of a convolution."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from articulate_ssl.ops.extreme_index import indices_of_smallest
from articulate_ssl.ops.kd_tree import kd_tree

_TILE_ELEMENTS = {"cpu": 2**16, "cuda": 2**27}  # distances held at a time: few enough to stay in cache on a CPU
# Distances from which a tree is faster on a CPU: 512 x 256 by 2.6 times, 4096 x 1024 by twenty (step 209).
_TREE_FROM = 2**17
KERNEL_RADIUS = 0.7  # kernel points lie within this fraction of the ball's radius
INFLUENCE = 0.5  # sigma / radius^2, the squared distance at which a kernel point's influence ends


class Neighbors(NamedTuple):
    """Nearest neighbours of M centres; radius-free, so that layers of any radius share one search.

    Attributes:
        index: [B, M, n] int64 into the N points, in no particular order.
        offset: [B, 3, M, n] x_j - x_i.
        num_points: N.
    """

    index: Tensor
    offset: Tensor
    num_points: int

    def leading(self, num_centers: int) -> Neighbors:
        """Neighbours of the first centres only."""
        return self._replace(index=self.index[:, :num_centers], offset=self.offset[:, :, :num_centers])


class Neighborhood(NamedTuple):
    """Neighbours and their correlation with every kernel point.

    Attributes:
        index: [B, M, n] int64 into the N points; slots outside the ball hold a valid index and zero weight.
        weight: [B, M, n, K] max(0, 1 - |d - kappa_k|^2 / sigma), divided by the number of neighbours in the ball.
        num_points: N.
    """

    index: Tensor
    weight: Tensor
    num_points: int

    def to(self, dtype: torch.dtype) -> Neighborhood:
        """Same neighbourhood with the weights in another floating type."""
        return self._replace(weight=self.weight.to(dtype))


@torch.no_grad()
def nearest_neighbors(
    points: Tensor,  # [B, N, 3]
    num_neighbors: int,
    centers: Tensor | None = None,  # [B, M] int64, default every point
) -> Neighbors:
    """The `num_neighbors` nearest points (at most N) of every centre, the centre itself included.

    Raises:
        ValueError: if `points` is not [B, N, 3] with N >= 1, or `centers` not [B, M].
    """
    if points.ndim != 3 or points.shape[-1] != 3 or points.shape[1] == 0:
        raise ValueError(f"points must be [B, N, 3] with at least one point, got {list(points.shape)}")
    if centers is not None and (centers.ndim != 2 or centers.shape[0] != points.shape[0]):
        raise ValueError(f"centers must be [{points.shape[0]}, M] indices of points, got {list(centers.shape)}")
    N = points.shape[1]
    queries = points if centers is None else points.gather(1, centers[..., None].expand(-1, -1, 3))
    index = nearest_indices(queries, points, num_neighbors)
    neighbor = (
        points.transpose(1, 2).gather(2, index.flatten(1)[:, None].expand(-1, 3, -1)).unflatten(2, index.shape[1:])
    )
    return Neighbors(index, neighbor - queries.transpose(1, 2)[..., None], N)


def nearest_indices(
    queries: Tensor,  # [B, M, 3]
    points: Tensor,  # [B, N, 3]
    count: int,
) -> Tensor:  # [B, M, min(count, N)] int64
    """The nearest points of every query, in no particular order."""
    many = points.device.type == "cpu" and queries.shape[1] * points.shape[1] >= _TREE_FROM
    # A tree takes no NaN.
    search = _by_tree if many and torch.isfinite(points).all() and torch.isfinite(queries).all() else _by_tiles
    return search(queries, points, min(count, points.shape[1]))


def _by_tree(queries: Tensor, points: Tensor, count: int) -> Tensor:  # [B, M, count]
    """Indices of the nearest points, by a tree of each cloud."""
    clouds = zip(points.detach().double().numpy(), queries.detach().double().numpy(), strict=True)
    found = [torch.from_numpy(kd_tree(cloud).query(some, count)[1]) for cloud, some in clouds]
    return torch.stack(found).view(*queries.shape[:2], count)  # of one neighbour SciPy leaves the last dimension out


def _by_tiles(queries: Tensor, points: Tensor, count: int) -> Tensor:  # [B, M, count]
    """The same by all distances, some at a time."""
    M, N, tile = queries.shape[1], points.shape[1], _TILE_ELEMENTS[points.device.type]
    samples, rows = max(1, tile // (M * N)), max(1, tile // N)
    found = [
        torch.cat([indices_of_smallest(_squared_distance(q, cloud), count) for q in some.split(rows, dim=1)], dim=1)
        for some, cloud in zip(queries.split(samples), points.split(samples), strict=True)
    ]
    return torch.cat(found)


def _squared_distance(queries: Tensor, points: Tensor) -> Tensor:
    """[B, M, N] by differences, not by the expanded square: exact for coincident points and far from the origin."""
    pairs = zip(queries[..., None].unbind(2), points[:, None].unbind(3), strict=True)
    first, *others = (q - p for q, p in pairs)
    square = first.square_()
    for difference in others:
        square.addcmul_(difference, difference)
    return square


@torch.no_grad()
def correlate(
    neighbors: Neighbors,
    radius: float,
    kernel_points: Tensor,  # [K, 3] unit scale
) -> Neighborhood:
    """Correlation weights of the neighbours inside the ball.

    The original fills a ball's missing slots by repeating the found neighbours, so that every point sums n entries;
    dividing by the number of neighbours found is the same normalisation without the repetition.
    """
    offset = neighbors.offset
    B, _, M, n = offset.shape
    sigma = INFLUENCE * radius**2
    square = offset.square().sum(dim=1, keepdim=True)  # [B, 1, M, n]
    inside = (square <= radius**2).to(offset)
    share = inside / inside.sum(dim=-1, keepdim=True).clamp(min=1)
    # 1 - |d - kappa|^2 / sigma is linear in (1, |d|^2, d), and max(0, .) commutes with the positive share: one product.
    terms = torch.cat([torch.ones_like(square), square, offset], dim=1).mul_(share).flatten(2)  # [B, 5, M n]
    kernel = kernel_points.to(offset) * (KERNEL_RADIUS * radius)
    constant = 1 - kernel.square().sum(dim=-1) / sigma
    coefficients = torch.stack([constant, torch.full_like(constant, -1 / sigma), *(2 / sigma * kernel).unbind(-1)])
    weight = (terms.transpose(1, 2) @ coefficients).relu_()  # [B, M n, K]
    return Neighborhood(neighbors.index, weight.view(B, M, n, -1), neighbors.num_points)


def build_neighborhood(
    points: Tensor,  # [B, N, 3]
    radius: float,
    kernel_points: Tensor,  # [K, 3] unit scale
    num_neighbors: int,
    centers: Tensor | None = None,  # [B, M] int64, default every point
) -> Neighborhood:
    """Neighbourhoods of radius `radius`, the nearest `num_neighbors` points at most, with their kernel correlation.

    Geometry is constant to the convolution: no gradient reaches `points`.

    Raises:
        ValueError: if `points` is not [B, N, 3] with N >= 1, or `centers` not [B, M].
    """
    return correlate(nearest_neighbors(points, num_neighbors, centers), radius, kernel_points)
