"""Chamfer distance: nearest neighbours without gradient, then the distance to them with gradient.

The gradient of a minimum is that of the entry that attains it, so differentiating the whole distance matrix is wasted.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from articulate_ssl.ops.extreme_index import index_of_smallest

_TILE_ELEMENTS = {"cpu": 2**18, "cuda": 2**27}  # entries of a distance matrix held at a time
_TINY = 1e-12  # squared distances below have zero gradient instead of an infinite one


@torch.no_grad()
def nearest_index(
    query: Tensor,  # [*, N, 3]
    target: Tensor,  # [*, M, 3]
    excluded: Tensor | None = None,  # [*, M] bool
) -> Tensor:  # [*, N] int64
    """Index of the target point nearest to every query point, among those not `excluded`.

    Of several that are equally near to about 1e-4 of the squared distance it is any (`index_of_smallest`).
    """
    index = torch.empty(query.shape[:-1], dtype=torch.int64, device=query.device).flatten(0, -2)
    for rows, square in _distance_tiles(query, target, excluded):
        index[rows] = index_of_smallest(square)
    return index.view(query.shape[:-1])


@torch.no_grad()
def nearest_distance(
    query: Tensor,  # [*, N, 3]
    target: Tensor,  # [*, M, 3]
) -> Tensor:  # [*, N]
    """Distance of every query point to its nearest target point, for choosing (no gradient).

    Faster than finding which point it is. Distances below 1e-3 of the target's extent carry float32's
    cancellation error; see `nearest_squared_distance` for the exact ones.
    """
    distance = query.new_empty(query.shape[:-1]).flatten(0, -2)
    for rows, square in _distance_tiles(query, target):
        distance[rows] = square.amin(dim=-1)
    return _length(distance, squared=False).view(query.shape[:-1])


def nearest_squared_distance(
    query: Tensor,  # [*, N, 3]
    target: Tensor,  # [*, M, 3]
) -> Tensor:  # [*, N]
    """Squared distance of every query point to its nearest target point; differentiable in both."""
    index = nearest_index(query, target)
    return (query - target.gather(-2, index[..., None].expand_as(query))).square().sum(dim=-1)


def chamfer(
    points: Tensor,  # [*, N, 3]
    target: Tensor,  # [*, M, 3]
    squared: bool = False,
    bidirectional: bool = True,
    weight: Tensor | None = None,  # [*, N]
) -> Tensor:  # [*]
    """Mean distance of the points to the target, plus with `bidirectional` that of the target to the points.

    Args:
        squared: squared distances instead of lengths (L1 type).
        weight: makes the first term a weighted mean over the points.
    """
    distance = _length(nearest_squared_distance(points, target), squared)
    forward = distance.mean(dim=-1) if weight is None else (weight * distance).sum(dim=-1) / weight.sum(dim=-1)
    if not bidirectional:
        return forward
    return forward + _length(nearest_squared_distance(target, points), squared).mean(dim=-1)


@torch.no_grad()
def hypothesis_distances(
    points: Tensor,  # [B, N, 3]
    posed: Tensor,  # [B, H, M, 3] one reconstruction per hypothesis
    squared: bool = False,
    bidirectional: bool = True,
) -> Tensor:  # [B, H]
    """Chamfer distance of every cloud to each of its hypotheses, for choosing among them (no gradient).

    Distances below 1e-3 of the cloud's extent carry float32's cancellation error; see `chamfer` for the exact ones.
    """
    B, H, M, _ = posed.shape
    N = points.shape[1]
    left, right = _factors(points[:, None].expand(-1, H, -1, -1).flatten(0, 1), posed.flatten(0, 1))
    problems = min(B * H, max(1, _TILE_ELEMENTS[points.device.type] // (N * M)))
    buffer = left.new_empty(problems, N, M)
    to_posed, to_points = left.new_empty(B * H, N), left.new_empty(B * H, M)
    for start in range(0, B * H, problems):
        block = slice(start, min(start + problems, B * H))
        square = torch.bmm(left[block], right[block], out=buffer[: block.stop - start])
        torch.amin(square, 2, out=to_posed[block])
        if bidirectional:
            torch.amin(square, 1, out=to_points[block])
    result = _length(to_posed, squared).mean(dim=-1)
    if bidirectional:
        result += _length(to_points, squared).mean(dim=-1)
    return result.view(B, H)


def _distance_tiles(
    query: Tensor, target: Tensor, excluded: Tensor | None = None
) -> Iterator[tuple[tuple[slice, slice], Tensor]]:
    """Squared distances [b, n, M] of blocks of problems and query rows; every block overwrites the one before.

    Excluded targets are infinitely far.
    """
    left, right = _factors(query.flatten(0, -3), target.flatten(0, -3))
    if excluded is not None:
        right[:, -1].masked_fill_(excluded.flatten(0, -2), torch.inf)
    batch, N, _ = left.shape
    M = right.shape[2]
    budget = _TILE_ELEMENTS[query.device.type]
    rows = min(N, max(1, budget // M))
    problems = min(batch, max(1, budget // (rows * M)))
    buffer = left.new_empty(problems * rows * M)
    for b in range(0, batch, problems):
        for i in range(0, N, rows):
            place = slice(b, b + problems), slice(i, i + rows)
            block = left[place]
            square = buffer[: block.shape[0] * block.shape[1] * M].view(*block.shape[:2], M)
            torch.bmm(block, right[place[0]], out=square)
            yield place, square


def _factors(query: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """[b, N, 5] and [b, 5, M] whose product is |x - y|^2, from coordinates about the target's mean."""
    query, target = query.detach(), target.detach()
    mean = target.mean(dim=1, keepdim=True)
    x, y = query - mean, target - mean
    one = torch.ones_like(x[..., :1]), torch.ones_like(y[..., :1])
    left = torch.cat([x, x.square().sum(dim=-1, keepdim=True), one[0]], dim=-1)
    right = torch.cat([-2 * y, one[1], y.square().sum(dim=-1, keepdim=True)], dim=-1)
    return left, right.transpose(1, 2)


def _length(square: Tensor, squared: bool) -> Tensor:
    return square.clamp(min=0) if squared else square.clamp(min=_TINY).sqrt()
