"""Errors of part poses, joints, segmentation and reconstruction, as pure functions.

The `legacy_*` functions repeat what the original implementation scores (`original-implementation.md`, section 6); they
exist only so that the paper's tables can be compared. Angles are radians here and degrees in reports.
"""

from __future__ import annotations

import math

import numpy as np
import roma
import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from articulate_ssl.ops.kd_tree import kd_tree

PARALLEL_BELOW = math.radians(1.0)
SKEW_ABOVE = math.radians(5.0)

FLIP_DEG = 90.0
ABOVE_DEG = 30.0  # a cabinet turned by 78 degrees is wrong, and no flip; chosen without a measurement


def rotation_error(
    predicted: Tensor,  # [..., 3, 3]
    target: Tensor,  # [..., 3, 3]
) -> Tensor:  # [...], in [0, pi]
    """Geodesic angle between rotations, unfolded.

    Goes through unit quaternions, whose half angle keeps full precision at 0 and at pi, where the arc cosine of the
    trace and the arc sine of the chord respectively lose half of the digits.
    """
    return roma.unitquat_geodesic_distance(roma.rotmat_to_unitquat(predicted), roma.rotmat_to_unitquat(target))


def translation_error(
    predicted: Tensor,  # [..., 3]
    target: Tensor,  # [..., 3]
) -> Tensor:  # [...]
    """Euclidean distance."""
    return torch.linalg.vector_norm(predicted - target, dim=-1)


def axis_angle_error(
    predicted: Tensor,  # [..., 3], any length but zero
    target: Tensor,  # [..., 3]
) -> Tensor:  # [...], in [0, pi/2]
    """Angle between undirected axes."""
    cross = torch.linalg.vector_norm(torch.linalg.cross(predicted, target), dim=-1)
    return torch.atan2(cross, (predicted * target).sum(-1).abs())


def point_to_line_distance(
    point: Tensor,  # [..., 3]
    axis: Tensor,  # [..., 3], unit
    pivot: Tensor,  # [..., 3], a point on the line
) -> Tensor:  # [...]
    """Distance of a point from an infinite line."""
    return torch.linalg.vector_norm(torch.linalg.cross(point - pivot, axis), dim=-1)


def line_to_line_distance(
    predicted_axis: Tensor,  # [..., 3], unit
    predicted_pivot: Tensor,  # [..., 3]
    target_axis: Tensor,  # [..., 3], unit
    target_pivot: Tensor,  # [..., 3]
) -> Tensor:  # [...]
    """Smallest distance between two infinite lines (ANCSH, Li et al. 2020), finite for every pair of lines.

    Between nearly parallel lines that distance is ill-conditioned: lines that stay far apart around the object may
    meet far away from it. Below 1 degree between the axes this is the distance of the target pivot from the predicted
    line, above 5 degrees the line-to-line distance, and in between a smoothstep blend (in the angle) of the two.
    """
    normal = torch.linalg.cross(predicted_axis, target_axis)
    sine = torch.linalg.vector_norm(normal, dim=-1)
    offset = target_pivot - predicted_pivot
    skew = (offset * normal).sum(-1).abs() / sine.clamp_min(math.sin(PARALLEL_BELOW))
    parallel = point_to_line_distance(target_pivot, predicted_axis, predicted_pivot)
    t = ((axis_angle_error(predicted_axis, target_axis) - PARALLEL_BELOW) / (SKEW_ABOVE - PARALLEL_BELOW)).clamp(0, 1)
    return torch.lerp(parallel, skew, t * t * (3 - 2 * t))


def wrap_angle(angle: Tensor) -> Tensor:
    """Equivalent angle in [-pi, pi]."""
    return torch.atan2(angle.sin(), angle.cos())


def state_error(
    predicted: Tensor,  # [..., J]
    target: Tensor,  # [..., J]
    is_revolute: Tensor,  # [..., J] bool
) -> Tensor:  # [..., J]
    """Absolute error of joint states: radians modulo a full turn for revolute joints, length for prismatic ones."""
    difference = predicted - target
    return torch.where(is_revolute, wrap_angle(difference), difference).abs()


def nearest_index(
    query: Tensor,  # [B, Q, 3]
    points: Tensor,  # [B, N, 3]
) -> tuple[Tensor, Tensor]:  # [B, Q] float64 distance, [B, Q] int64
    """Distance to, and index of, the nearest of `points` for every query point."""
    # k-d trees on the CPU: five times faster than a dense table there, and exact where matrix products lose digits.
    pairs = [
        kd_tree(p).query(q) for q, p in zip(query.double().cpu().numpy(), points.double().cpu().numpy(), strict=True)
    ]
    distance, index = (torch.from_numpy(np.stack(values)).to(query.device) for values in zip(*pairs, strict=True))
    return distance, index


def chamfer_l1(
    first: Tensor,  # [B, N, 3]
    second: Tensor,  # [B, M, 3]
) -> Tensor:  # [B] float64
    """Mean of the two directions' mean unsquared nearest-neighbour distances."""
    return (nearest_index(first, second)[0].mean(-1) + nearest_index(second, first)[0].mean(-1)) / 2


def iou_matrix(
    predicted: Tensor,  # [B, P] labels 0..K-1
    target: Tensor,  # [B, P] labels 0..K-1
    num_parts: int,
) -> Tensor:  # [B, K, K] float64, predicted label x target label
    """Intersection over union of every predicted segment with every true part; NaN where both are empty."""
    batch, points = predicted.shape
    pair = predicted.long() * num_parts + target.long()
    count = torch.zeros(batch, num_parts**2, dtype=torch.float64, device=predicted.device)
    count.scatter_add_(1, pair, torch.ones(batch, points, dtype=torch.float64, device=predicted.device))
    intersection = count.view(batch, num_parts, num_parts)
    return intersection / (intersection.sum(2, keepdim=True) + intersection.sum(1, keepdim=True) - intersection)


def part_iou(
    predicted: Tensor,  # [B, P]
    target: Tensor,  # [B, P]
    num_parts: int,
) -> Tensor:  # [B, K]
    """IoU of every part under the labels as they are; NaN for a part that is in neither segmentation."""
    return iou_matrix(predicted, target, num_parts).diagonal(dim1=-2, dim2=-1)


def best_assignment(
    score: Tensor,  # [C, C], larger is better
) -> Tensor:  # [C] int64, the row assigned to every column
    """Hungarian assignment of rows to columns (NaN counts as zero)."""
    row, column = linear_sum_assignment(score.nan_to_num().cpu().numpy(), maximize=True)
    result = torch.empty(score.shape[1], dtype=torch.long)
    result[torch.from_numpy(column)] = torch.from_numpy(row)
    return result.to(score.device)


def legacy_fold(
    angle: Tensor,  # radians in [0, pi]
) -> Tensor:
    """min(e, 180 degrees - e): a half turn counts as no error, and a random rotation scores 45 degrees."""
    return torch.minimum(angle, math.pi - angle)


def legacy_rematch(
    iou: Tensor,  # [B, K, K], predicted slot x true part
) -> Tensor:  # [B, K], the slot of every part
    """Slots re-assigned to parts for every sample by its own ground-truth segmentation."""
    return torch.stack([best_assignment(matrix) for matrix in iou])


def legacy_axis_error(
    predicted: Tensor,  # [B, J, 3], unit
    target: Tensor,  # [B, J, 3], unit
) -> Tensor:  # [B]
    """Arc cosine of the mean over joints of |cos|: one angle per object."""
    return (predicted * target).sum(-1).abs().mean(-1).clamp(max=1).acos()


def legacy_pivot_error(
    predicted_pivot: Tensor,  # [B, J, 3]
    target_axis: Tensor,  # [B, J, 3], unit
    target_pivot: Tensor,  # [B, J, 3]
    centroid: Tensor,  # [B, 3] of the input cloud
) -> Tensor:  # [B, J]
    """| ||p|| - dist(centroid, true line) |, p the predicted pivot seen from the centroid: compares two scalars.

    A true pivot scores zero only if it is the foot of the perpendicular from the centroid.
    """
    origin = centroid[:, None]
    norm = translation_error(predicted_pivot, origin)
    return (norm - point_to_line_distance(origin, target_axis, target_pivot)).abs()


def legacy_chamfer(
    first: Tensor,  # [B, N, 3]
    second: Tensor,  # [B, M, 3]
) -> Tensor:  # [B] float64
    """Mean of the two directions' root-mean-square nearest-neighbour distances, which the original calls L1."""
    rms = [nearest_index(a, b)[0].square().mean(-1).sqrt() for a, b in ((first, second), (second, first))]
    return (rms[0] + rms[1]) / 2
