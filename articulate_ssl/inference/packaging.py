"""What is decided for, as a `Prediction`: parts of points, poses, joints in camera space."""

from __future__ import annotations

import torch
from torch import Tensor

from articulate_ssl.geometry.se3 import transform_points
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.inference.votes import Votes
from articulate_ssl.losses.reconstruction import distances_to_parts
from articulate_ssl.network.hypotheses import Hypotheses

# Weight of what similar views, or clouds, say about the part of a point, beside the posed shape: of 80 development
# views each the mIoU is 90, 91 and 47 (safes, washing machines, chests) by three quarters, 90, 89 and 44 by a half, 90,
# 81 and 35 by nothing (docs/experiments.md, step 99).
_VIEWS_SAY = 0.75


def as_prediction(
    chosen: Hypotheses,  # H = 1
    points: Tensor,  # [B, N, 3]
    distance: Tensor,  # [B] between them
    margin: Tensor,  # [B]
    posterior_scale: float,
    part_neighbours: int,
    votes: Votes | None = None,  # which parts points are of, beside the nearest of the posed ones
    dense: Tensor | None = None,  # [B, P, 3] more points that are labelled
) -> Prediction:
    """One hypothesis of every cloud, packaged.

    Args:
        posterior_scale: Standard deviation of the association of points with posed parts, in normalised units.
        part_neighbours: See `InferenceOptions`.
    """
    pose = chosen.object_pose()[:, 0]
    part_pose = pose.clone()
    part_pose[..., :3, 3] = transform_points(pose, chosen.assembly[:, :, None])[:, :, 0]
    chain = chosen.chain
    parent = torch.tensor(chain.parent, device=points.device)
    posed = chosen.posed()[:, 0]
    probability = _probability(points, posed, posterior_scale, part_neighbours, votes)
    every = None if dense is None else _probability(dense, posed, posterior_scale, part_neighbours, votes).argmax(-1)
    shape = (len(points), len(parent))
    axis, pivot = joint_lines(chosen, pose)
    return Prediction(
        part_id=probability.argmax(dim=-1),
        part_probability=probability,
        part_pose=part_pose,
        # The category's own are views of parameters, which ask for gradients even where none are taken.
        part_shape=chosen.part_shape.detach(),
        assembly=chosen.assembly.detach(),
        base_pose=chosen.base[:, 0],
        joint_parent=parent.expand(shape),
        joint_child=torch.tensor(chain.child, device=points.device).expand(shape),
        joint_type=torch.full(shape, chosen.structure.joint_type, device=points.device),
        joint_axis=axis,
        joint_pivot=pivot,
        joint_state=chosen.state[:, 0],
        canonical_axis=chosen.axis[:, 0],
        canonical_pivot=chosen.pivot,
        reconstruction_error=distance,
        margin=margin,
        dense_part_id=every,
    )


def _probability(
    points: Tensor,  # [B, N, 3]
    posed: Tensor,  # [B, K, M, 3]
    posterior_scale: float,
    part_neighbours: int,
    votes: Votes | None,
) -> Tensor:  # [B, N, K]
    """That points are of parts."""
    to_part = distances_to_parts(points, posed, part_neighbours)
    probability = (to_part.square() / (-2 * posterior_scale**2)).softmax(-1)
    return probability if votes is None else torch.lerp(probability, votes.at(points), _VIEWS_SAY)


def joint_lines(
    one: Hypotheses,  # H = 1
    pose: Tensor,  # [B, K, 4, 4] canonical object space -> camera space of every part
) -> tuple[Tensor, Tensor]:  # [B, J, 3], [B, J, 3]
    """Axes and pivots in camera space."""
    parent_pose = pose[:, list(one.chain.parent)]
    axis = (parent_pose[..., :3, :3] @ one.axis[:, 0, ..., None]).squeeze(-1)
    return axis, transform_points(parent_pose, one.pivot[:, :, None])[:, :, 0]
