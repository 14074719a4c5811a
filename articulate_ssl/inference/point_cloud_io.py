"""A user's scan as the network reads it, and coloured clouds as other programs read them.

Files are read by `datamodules.point_cloud_io`, which `make data` reads scans with too.
"""

from __future__ import annotations

import os

import numpy as np

from articulate_ssl.ops.farthest_point import farthest_point_order
from datamodules.atomic import atomic_write
from datamodules.point_cloud_io import MESH_SAMPLES, MIN_POINTS, PointCloudError, load_point_cloud

__all__ = ["MESH_SAMPLES", "MIN_POINTS", "PointCloudError", "load_point_cloud", "normalise_cloud", "save_coloured_ply"]


def save_coloured_ply(
    path: str | os.PathLike,
    points: np.ndarray,  # [N, 3]
    colours: np.ndarray,  # [N, 3] uint8
) -> None:
    """Write a coloured cloud as binary PLY, whole or not at all.

    Positions are float64: in float32 points of a scan that is far from its origin (in metres of a map) collapse.
    """
    rows = np.empty(len(points), dtype=[("position", "<f8", 3), ("colour", "u1", 3)])
    rows["position"], rows["colour"] = points, colours
    properties = [f"property double {axis}" for axis in "xyz"]
    properties += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *properties, "end_header"]
    with atomic_write(path) as file:
        file.write("".join(f"{line}\n" for line in header).encode() + rows.tobytes())


def normalise_cloud(
    points: np.ndarray,  # [N, 3]
    num_points: int,
    center: np.ndarray | None = None,  # [3]
    scale: float | None = None,
) -> tuple[np.ndarray, np.ndarray, float]:
    """The network's input: (points - center) / scale, evenly thinned to `num_points`, in farthest-point order.

    Without `center` and `scale` they are those of the honest partial protocol, from the observed points alone: the
    mean, and the mean distance to it divided by 0.3. Clouds of more than `MESH_SAMPLES` points are thinned at random
    (fixed seed) first. A cloud of fewer than `num_points` points repeats its points from the beginning.

    Returns:
        Normalised points [num_points, 3] float32, center [3] float64, scale.
    """
    points = np.asarray(points, dtype=np.float64)
    if center is None:
        center = points.mean(axis=0)
    if scale is None:
        scale = float(np.linalg.norm(points - center, axis=1).mean() / 0.3)
    normalised = ((points - center) / scale).astype(np.float32)
    if len(normalised) > MESH_SAMPLES:
        normalised = np.random.default_rng(0).permutation(normalised)[:MESH_SAMPLES]
    order = farthest_point_order(normalised, min(num_points, len(normalised)))
    return np.resize(normalised[order], (num_points, 3)), np.asarray(center, dtype=np.float64), scale
