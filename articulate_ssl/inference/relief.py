"""The relief of a cloud under a hypothesis: how rough, how thick and how large its parts are, and where.

A laptop's base and lid are plates of one size. Registration compares points that are spaced wider than keys are high,
so to it the two are alike; what tells them apart is measured here on all points, part by part, in the part's own axes.
What lies next to a joint is left out: to which part it belongs is known least.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.inference.packaging import joint_lines
from articulate_ssl.network.hypotheses import Hypotheses
from articulate_ssl.ops.kd_tree import kd_tree
from articulate_ssl.ops.least_variance import least_variance
from articulate_ssl.shape.stretch import principal_directions

# Normalised units from a revolute joint's line. On laptops labels near the hinge are a matter of taste; of 400 clouds
# .12 left 94 % decided rightly, .06 and .2 76 %, 0 less (docs/experiments.md, step 57).
_NEAR_JOINT = 0.12
_FEWEST = 60  # points of a part: with fewer there is no relief
_NEIGHBOURS = (9, 25)  # of a point, whose deviation from a plane is its roughness
_BINS = 4  # along the middle axis of a part
_HEIGHTS = (50, 75, 90)  # percentiles of the distance of a side's points from its median plane
_LEAST = 1e-5  # normalised units, below which lengths are alike
_FAR = 0.003  # normalised units: more is no longer the face itself
_PER_SIDE = 2 * len(_NEIGHBOURS) + len(_HEIGHTS) + 1 + _BINS * (1 + len(_NEIGHBOURS))
NUM_FEATURES = 5 + 2 * _PER_SIDE  # of a part


def describe_relief(
    points: np.ndarray,  # [P, 3]
    label: np.ndarray,  # [P] int, their parts
    part_pose: np.ndarray,  # [K, 4, 4] canonical object space -> points
    axes: np.ndarray,  # [K, 3, 3] columns: axes of every part in canonical object space, the thinnest first
    pivot: np.ndarray,  # [J, 3] of the joints that turn, among the points
    axis: np.ndarray,  # [J, 3] unit
) -> np.ndarray:  # [K * NUM_FEATURES]
    """What the hypothesis says of every part; NaN for a part of fewer than 60 points, or of no thickness at all.

    Per part: logarithms of the extents, the share of the points, that of its upper half (along its thinnest axis), and
    per half: medians and upper quartiles of the roughness, heights, and along the middle axis counts and roughness.
    """
    offset = points[:, None] - pivot
    along = np.einsum("pji,ji->pj", offset, axis)
    kept = np.ones(len(points), dtype=bool)
    if len(pivot):
        line = np.sqrt(np.maximum((offset**2).sum(axis=-1) - along**2, 0))
        kept = line.min(axis=1) > _NEAR_JOINT
    points, label = points[kept], label[kept]
    return np.concatenate([_part(points[label == k], len(points), part_pose[k], axes[k]) for k in range(len(axes))])


def roughness(
    points: np.ndarray,  # [m, 3]
) -> np.ndarray:  # [m, 2]
    """Logarithm of every point's neighbourhoods' standard deviation from their planes."""
    neighbours = kd_tree(points).query(points, k=max(_NEIGHBOURS))[1]
    return np.log(np.sqrt(least_variance(points, neighbours, _NEIGHBOURS)) + 10 * _LEAST)


def _part(points: np.ndarray, total: int, pose: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """See `describe_relief`, of one part."""
    if len(points) < _FEWEST:
        return np.full(NUM_FEATURES, np.nan)
    rough = roughness(points)
    placed = _in_own_axes((points - pose[:3, 3]) @ pose[:3, :3] @ axes)
    low, high = np.percentile(placed, [1, 99], axis=0)
    upper = placed[:, 0] > (low[0] + high[0]) / 2
    if not (high > low).all() or upper.all() or not upper.any():
        return np.full(NUM_FEATURES, np.nan)
    where = np.clip((placed[:, 1] - low[1]) / (high[1] - low[1]) * _BINS, 0, _BINS - 1).astype(int)
    values = [*np.log(high - low + _LEAST), np.log(len(points) / total), upper.mean()]
    for half in (~upper, upper):
        height = np.abs(placed[half, 0] - np.median(placed[half, 0]))
        values += [*np.median(rough[half], axis=0), *np.percentile(rough[half], 75, axis=0)]
        values += [*np.log(np.percentile(height, _HEIGHTS) + _LEAST), (height > _FAR).mean()]
        for b in range(_BINS):
            here = half & (where == b)
            some = rough[here] if here.any() else rough[half]
            values += [here.mean(), *np.median(some, axis=0)]
    return np.array(values)


def _in_own_axes(points: np.ndarray) -> np.ndarray:
    """Points [m, 3] about their mean, in their own principal axes, ordered and signed as the given ones are."""
    points = points - points.mean(axis=0)
    own = np.linalg.eigh(points.T @ points)[1]
    given, nearest = linear_sum_assignment(-np.abs(own))
    own = own[:, nearest]
    return points @ (own * np.sign(own[given, given]))


def relief_of(
    one: Hypotheses,  # H = 1
    parts: Sequence[Tensor],  # [M, 3] of each part of the category's shape
    dense: Tensor,  # [B, P, 3]
) -> Tensor:  # [B, K * NUM_FEATURES]
    """The relief of clouds under an explanation of each (`describe_relief`)."""
    axes = torch.stack([principal_directions(part) for part in parts]).double().cpu().numpy()
    pose, posed = one.object_pose()[:, 0], one.posed()[:, 0]
    axis, pivot = joint_lines(one, pose)
    if one.structure.joint_type != REVOLUTE:
        axis, pivot = axis[:, :0], pivot[:, :0]
    arrays = (value.double().cpu().numpy() for value in (dense, posed, pose, pivot, axis))
    described = []
    for cloud, shape, *lines in zip(*arrays, strict=True):
        nearest = kd_tree(shape.reshape(-1, 3)).query(cloud)[1]
        described.append(describe_relief(cloud, nearest // shape.shape[1], lines[0], axes, *lines[1:]))
    return torch.from_numpy(np.stack(described)).to(dense)
