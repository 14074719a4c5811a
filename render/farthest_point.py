"""Farthest-point order of point clouds."""

from __future__ import annotations

import fpsample
import numpy as np

_SMALLEST_TREE = 64


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
    height = 5 if len(points) >= _SMALLEST_TREE else 1
    order = fpsample.bucket_fps_kdline_sampling(points.astype(np.float32, copy=False), num_points, h=height)
    return order.astype(np.int64)
