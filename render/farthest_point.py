"""Farthest-point order of point clouds."""

from __future__ import annotations

import fpsample
import numpy as np

_TREE_HEIGHT = 5


def farthest_points_first(
    points: np.ndarray,  # [N, 3], in random order
    num_ordered: int = 2048,
) -> np.ndarray:  # [N]
    """A permutation that begins with a farthest-point order of `num_ordered` points; the others keep their order."""
    first = farthest_point_order(points, min(num_ordered, len(points)))
    others = np.ones(len(points), dtype=bool)
    others[first] = False
    return np.concatenate([first, np.flatnonzero(others)])


def farthest_point_order(
    points: np.ndarray,  # [N, 3]
    num_points: int,
) -> np.ndarray:  # [num_points]
    """Indices such that every next point is a farthest one from those before it: each prefix is an even sample.

    Exact farthest-point sampling with a bucketed kd-tree (QuickFPS, Han et al. 2023). The start point is arbitrary but
    a function of the points.

    Raises:
        ValueError: if there are fewer than `num_points` points.
    """
    if len(points) < num_points:
        raise ValueError(f"cannot choose {num_points} of {len(points)} points")
    if len(points) == 1:
        return np.zeros(num_points, dtype=np.int64)
    height = min(_TREE_HEIGHT, len(points).bit_length() - 1)
    # Without a start index fpsample draws one from numpy's global generator.
    order = fpsample.bucket_fps_kdline_sampling(points.astype(np.float32), num_points, h=height, start_idx=0)
    order = order.astype(np.int64)
    left = np.ones(len(points), dtype=bool)
    left[order] = False
    if left.sum() == len(points) - num_points:
        return order
    # When only copies of chosen points are left it repeats itself: those copies follow in their own order instead.
    unique = order[np.sort(np.unique(order, return_index=True)[1])]
    return np.concatenate([unique, np.flatnonzero(left)])[:num_points]
