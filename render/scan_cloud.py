"""One scan as a data set stores it: as many points as every cloud, in an order whose every beginning is even."""

from __future__ import annotations

import numpy as np

from render.complete_cloud import OVERSAMPLING
from render.farthest_point import farthest_point_order, farthest_points_first
from render.partial_cloud import HONEST_MEAN_DISTANCE


def choose_points(
    points: np.ndarray,  # [N, 3]
    count: int,
    view: str,
    rng: np.random.Generator,
) -> np.ndarray:  # [count, 3]
    """The points of a scan that are stored, chosen and ordered as rendered clouds are.

    Complete: the farthest-point order of twice as many random ones, which evens out how densely they were scanned.
    Depth view: random ones, as random pixels are, of which the first 2048 are in farthest-point order. A scan of fewer
    points has them all, and repeats them from the first on.
    """
    candidates = min(len(points), count if view == "partial" else OVERSAMPLING * count)
    chosen = points[rng.choice(len(points), candidates, replace=False)]
    order = farthest_points_first(chosen) if view == "partial" else farthest_point_order(chosen, min(count, candidates))
    return np.resize(chosen[order], (count, 3))


def size_of(
    points: np.ndarray,  # [P, 3] as stored
) -> float:
    """What is observed of an object's size: the points' mean distance to their centre, over .3.

    The scale of the `honest` protocol. Complete clouds of procedural objects have .21 to .40 of the rest-state diagonal
    in place of the .3, so this is roughly the diagonal.
    """
    return float(np.linalg.norm(points - points.mean(axis=0), axis=1).mean()) / HONEST_MEAN_DISTANCE


def refuse_camera(
    points: np.ndarray,  # [N, 3]
) -> None:
    """Raise ValueError if no depth camera with x right, y down and z forward can have seen a cloud."""
    if points[:, 2].max() <= 0:
        raise ValueError(
            "all points are behind the camera (z is negative); a depth view has x right, y down and z forward: if "
            "these are OpenGL's axes, multiply y and z by -1; if this is no depth view, leave VIEW=partial out"
        )
    if points[:, 2].min() <= 0:
        raise ValueError(
            f"z goes from {points[:, 2].min():.4g} to {points[:, 2].max():.4g}: the camera would be inside the object; "
            "a depth view has the camera at the origin, x right, y down and z forward: if it was centred, add the "
            "distance to z"
        )
