"""What an instance adds to a category's shape: every part stretched along its own principal axes.

Every part k of an instance is x -> S_k x + d_k of the category's, with S_k = A_k exp(diag(s_k)) A_k^T, principal axes
A_k and log-stretches s_k. The network predicts d_k, the change of the assembling translation, freely; in the instance
fit it follows from the parts staying on their hinges (`hinged`). In both, log-stretches are bounded smoothly.
"""

from __future__ import annotations

import torch
from torch import Tensor

from articulate_ssl.geometry.se3 import se3
from articulate_ssl.shape.joints import Joints
from articulate_ssl.shape.part_maps import PartMaps


def principal_directions(
    points: Tensor,  # [m, D]
) -> Tensor:  # [D, D]
    """Columns: principal axes of points about their mean, the direction of least variance first."""
    offset = points - points.mean(dim=0)
    return torch.linalg.eigh(offset.T @ offset).eigenvectors


def principal_frame(
    points: Tensor,  # [m, 3]
) -> Tensor:  # [4, 4]
    """The pose that moves points to their centre and principal axes (right-handed)."""
    axes = principal_directions(points)
    axes = axes * torch.sign(torch.linalg.det(axes))
    return se3(axes.T, -(axes.T @ points.mean(dim=0)))


def stretch_matrices(
    axes: Tensor,  # [K, 3, 3] columns
    log_stretch: Tensor,  # [n, K, 3] along them
) -> Tensor:  # [n, K, 3, 3]
    """S_k = A_k exp(diag(s_k)) A_k^T."""
    return (axes * log_stretch.exp()[..., None, :]) @ axes.transpose(-1, -2)


def hinged(
    stretch: Tensor,  # [n, K, 3, 3]
    center: Tensor,  # [3] of the root
    joints: Joints,
) -> tuple[PartMaps, Tensor]:
    """Parts stretched so that they stay on their hinges: the root about its centre, others about their joint's pivot.

    Returns:
        The maps from the category's shape to the instances', and the instances' pivots [n, J, 3], which move with the
        parts they are on.
    """
    chain = joints.chain
    shift = {chain.root: center - _mapped(stretch[:, chain.root], center)}
    pivots = []
    for pivot, parent, child in zip(joints.pivot.unbind(-2), chain.parent, chain.child, strict=True):
        pivots.append(_mapped(stretch[:, parent], pivot) + shift[parent])
        shift[child] = pivots[-1] - _mapped(stretch[:, child], pivot)
    maps = PartMaps(stretch, torch.stack([shift[part] for part in range(chain.num_parts)], dim=1))
    return maps, torch.stack(pivots, dim=1) if pivots else stretch.new_zeros(len(stretch), 0, 3)


def _mapped(linear: Tensor, point: Tensor) -> Tensor:
    """Points [3] or [n, 3] under linear maps [n, 3, 3]."""
    return (linear @ point[..., None]).squeeze(-1)
