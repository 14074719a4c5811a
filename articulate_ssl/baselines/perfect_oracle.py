"""Ground truth as a prediction: what any honest metric must score without error."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import one_hot

from articulate_ssl.geometry.se3 import invert_se3, se3, transform_points
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.metrics.functional import nearest_index


def part_points(
    points: Tensor,  # [N, 3]
    part_id: Tensor,  # [N]
    part: int,
    count: int,
    fallback: Tensor,  # [3]
) -> Tensor:  # [count, 3]
    """The points of one part, repeated in turn up to `count`; `fallback` for a part without points."""
    own = points[part_id == part]
    if len(own) == 0:
        own = fallback[None]
    return own[torch.arange(count, device=points.device) % len(own)]


def perfect_oracle(labels: dict[str, Tensor]) -> Prediction:
    """The labels, said as a prediction.

    Every input point takes the part of its nearest dense point, and part shapes are the observed points themselves,
    moved back to rest. The canonical object space is the labelled one; every canonical part space has the same axes and
    the part's bounding-box centre as its origin, which is the point that translation errors compare.

    Args:
        labels: shard arrays of B clouds; `points` [B, N, 3] are the clouds under test.
    """
    points, object_to_part, center = labels["points"], labels["part_pose"], labels["part_center"]
    clouds, count, _ = points.shape
    num_parts = center.shape[1]
    pose = object_to_part @ se3(torch.eye(3, dtype=center.dtype, device=center.device), center)
    nearest = nearest_index(points, labels["dense_points"])[1]
    part_id = labels["dense_part_id"].long().gather(1, nearest)
    observed = torch.stack(
        [
            torch.stack([part_points(points[b], part_id[b], k, count, pose[b, k, :3, 3]) for k in range(num_parts)])
            for b in range(clouds)
        ]
    )  # [B, K, N, 3]
    parent, child = labels["joint_parent"].long(), labels["joint_child"].long()
    base = next(k for k in range(num_parts) if k not in set(child[0].tolist()))
    base_pose = object_to_part[:, base]
    to_canonical = invert_se3(base_pose)
    axis, pivot = labels["joint_axis"], labels["joint_pivot"]
    return Prediction(
        part_id=part_id,
        part_probability=one_hot(part_id, num_parts).to(points.dtype),
        part_pose=pose,
        part_shape=transform_points(invert_se3(pose), observed),
        assembly=center,
        base_pose=base_pose,
        joint_parent=parent,
        joint_child=child,
        joint_type=labels["joint_type"].long(),
        joint_axis=axis,
        joint_pivot=pivot,
        joint_state=labels["joint_state"],
        canonical_axis=axis @ to_canonical[:, :3, :3].transpose(-1, -2),
        canonical_pivot=transform_points(to_canonical, pivot),
        reconstruction_error=points.new_zeros(clouds),
        margin=points.new_ones(clouds),
    )
