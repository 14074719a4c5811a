"""Farthest-point sampling of one cloud."""

from __future__ import annotations

import numpy as np


def farthest_point_order(
    points: np.ndarray,  # [N, 3]
    count: int,
) -> np.ndarray:  # [count] indices
    """Farthest-point sampling from the point farthest from the mean: any beginning of it is an even sample."""
    columns = np.ascontiguousarray(points.T, dtype=np.float32)
    squared = ((columns - columns.mean(axis=1, keepdims=True)) ** 2).sum(axis=0)
    order = np.empty(count, dtype=np.int64)
    order[0] = squared.argmax()
    squared = np.full(len(points), np.inf, dtype=np.float32)
    for i in range(1, count):
        np.minimum(squared, ((columns - columns[:, order[i - 1], None]) ** 2).sum(axis=0), out=squared)
        order[i] = squared.argmax()
    return order
