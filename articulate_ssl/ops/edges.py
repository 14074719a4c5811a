"""Sums over the correlated pairs of points and centres, tile by tile: what depth-wise convolutions are made of."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.nn.functional import pad

_PADDING = 4  # edges of a target are padded to a multiple of this, so that few lengths occur


class Edges:
    """The correlated pairs from points to centres, or reversed, and sums over them, tile by tile.

    Targets are taken in the order of their degree, so that a tile pads little: a point has up to twice as many centres
    as a centre has points, and pairs outside the ball are no edges.

    Attributes:
        order: [T] targets by degree, rounded up to what they are padded to.
        rank: [T] place of every target in `order`.
    """

    def __init__(
        self,
        index: Tensor,  # [B, M, n] into N points
        correlation: Tensor,  # [B, M, n, K]
        num_points: int,
        width: int,
        tile: int,
        reverse: bool = False,
    ) -> None:
        """Neighbourhoods, N, features of a source that are summed at a time, and how many of them a tile gathers.

        `reverse` makes sources of the centres and targets of the points.
        """
        B, N = len(index), num_points
        _, M, n, K = correlation.shape
        correlation = correlation.flatten(0, 2)  # [B M n, K]
        point = (index + N * torch.arange(B, device=index.device)[:, None, None]).flatten()
        edge = correlation.any(dim=1).nonzero().squeeze(1)  # by centre
        if reverse:
            edge = edge[point[edge].argsort(stable=True)]
        source, target, num_targets = (edge // n, point[edge], B * N) if reverse else (point[edge], edge // n, B * M)
        degree = target.bincount(minlength=num_targets)
        first = degree.cumsum(0) - degree
        length = (degree + _PADDING - 1) // _PADDING * _PADDING
        self.order = length.argsort(stable=True)
        self.rank = self.order.argsort()
        lengths, counts = (t.tolist() for t in length[self.order].unique_consecutive(return_counts=True))
        edge, source = (pad(t, (0, lengths[-1])) for t in (edge, source))
        self._tiles = []
        start = 0
        for longest, count in zip(lengths, counts, strict=True):
            targets = self.order[start : start + count, None]
            place = torch.arange(longest, device=index.device)
            chosen = (first[targets] + place).flatten()
            weight = correlation.index_select(0, edge[chosen]).view(count, longest, K)
            weight *= (place < degree[targets])[..., None]
            sources = source[chosen].view(count, longest)
            size = max(1, tile // (max(1, longest) * width))
            for part, neighbors in zip(weight.split(size), sources.split(size), strict=True):
                rows = slice(start, start + len(part))
                self._tiles.append((rows, neighbors.flatten(), part.transpose(1, 2)))
                start = rows.stop
        self._gathered = correlation.new_empty(width * max(len(sources) for _, sources, _ in self._tiles))
        self._aggregate = correlation.new_empty(width * max(weight.shape[0] for _, _, weight in self._tiles) * K)

    def aggregates(self, block: Tensor) -> Iterator[tuple[slice, Tensor]]:
        """Places in `order`, and their aggregates [t, K, s C] of the sources' features [S, s C]; in one buffer."""
        width = block.shape[1]
        for rows, sources, weight in self._tiles:
            count, K, longest = weight.shape
            gathered = self._gathered[: len(sources) * width].view(-1, width)
            torch.index_select(block, 0, sources, out=gathered)
            aggregate = self._aggregate[: count * K * width].view(count, K, width)
            torch.bmm(weight, gathered.view(count, longest, width), out=aggregate)
            yield rows, aggregate
