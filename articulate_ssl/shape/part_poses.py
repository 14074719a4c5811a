"""From coordinates of points in part spaces to poses of parts, and from these to joint states.

Part spaces have the axes of the object at rest and the part's centre as origin (NPCS, Li et al. 2020; joints as in
ANCSH). Clouds are normalised already, so a part's pose is rigid.
"""

from __future__ import annotations

from collections.abc import Sequence

import roma
import torch
from torch import Tensor

from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.geometry.se3 import se3


def rigid_fit(
    source: Tensor,  # [..., n, 3]
    target: Tensor,  # [..., n, 3]
    weight: Tensor,  # [..., n], not negative, not all zero
) -> Tensor:  # [..., 4, 4]
    """Pose that moves source to target with the least weighted squared distance (Kabsch, Umeyama at scale one)."""
    weight = (weight / weight.sum(-1, keepdim=True).clamp(min=1e-12))[..., None]
    source_mean, target_mean = (weight * source).sum(-2), (weight * target).sum(-2)
    covariance = ((target - target_mean[..., None, :]) * weight).transpose(-1, -2) @ (
        source - source_mean[..., None, :]
    )
    rotation = roma.special_procrustes(covariance)
    return se3(rotation, target_mean - (rotation @ source_mean[..., None]).squeeze(-1))


def joint_states(
    pose: Tensor,  # [B, K, 4, 4] part space -> camera space
    center: Tensor,  # [B, K, 3] part centres in the object's rest-state frame
    axis: Tensor,  # [B, J, 3] unit, in the axes of part spaces, which are parallel at rest
    parent: Tensor | Sequence[int],  # [J]
    child: Tensor | Sequence[int],  # [J]
    joint_type: int,
) -> Tensor:  # [B, J], relative to rest
    """State of every joint by the pose of its child relative to its parent, about or along the axis."""
    turn_to_parent = pose[:, parent, :3, :3].transpose(-1, -2)
    if joint_type == REVOLUTE:
        relative = turn_to_parent @ pose[:, child, :3, :3]
        return (roma.rotmat_to_rotvec(relative) * axis).sum(-1)
    offset = (turn_to_parent @ (pose[:, child, :3, 3] - pose[:, parent, :3, 3])[..., None]).squeeze(-1)
    return ((offset - (center[:, child] - center[:, parent])) * axis).sum(-1)


def nearest_on_line(
    pivot: Tensor,  # [..., 3]
    axis: Tensor,  # [..., 3] unit
) -> Tensor:  # [..., 3]
    """The point of the joint line (pivot, axis) that is nearest to the origin: the one pivot that is well defined."""
    return pivot - (pivot * axis).sum(-1, keepdim=True) * axis


def part_shapes(
    coordinates: Tensor,  # [B, K, P, 3] of every point in every part's space
    part_id: Tensor,  # [B, P]
    count: int,
) -> Tensor:  # [B, K, count, 3]
    """Of every part the coordinates of its first points, over again if it has fewer; of one that has none, of all."""
    shapes = []
    for part, own in enumerate(coordinates.unbind(dim=1)):
        mine = part_id == part
        first = (~mine).to(torch.uint8).argsort(dim=1, stable=True)
        many = torch.where(mine.any(dim=1), mine.sum(dim=1), mine.shape[1])
        chosen = first.gather(1, torch.arange(count, device=first.device) % many[:, None])
        shapes.append(own.gather(1, chosen[..., None].expand(-1, -1, 3)))
    return torch.stack(shapes, dim=1)
