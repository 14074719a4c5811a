"""Rigid motions, SE(3): poses are 4x4 matrices acting on column vectors (`docs/conventions.md`)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional


def se3(
    rotation: Tensor,  # [..., 3, 3]
    translation: Tensor,  # [..., 3]
) -> Tensor:  # [..., 4, 4]
    """Pose from its rotation and translation."""
    batch = torch.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    pose = rotation.new_zeros(*batch, 4, 4)
    pose[..., :3, :3] = rotation
    pose[..., :3, 3] = translation
    pose[..., 3, 3] = 1.0
    return pose


def invert_se3(pose: Tensor) -> Tensor:
    """Inverse of rigid poses [..., 4, 4]."""
    rotation_t = pose[..., :3, :3].transpose(-1, -2)
    return se3(rotation_t, -(rotation_t @ pose[..., :3, 3:]).squeeze(-1))


def transform_points(
    pose: Tensor,  # [..., 4, 4]
    points: Tensor,  # [..., N, 3]
) -> Tensor:  # [..., N, 3]
    """Points moved by a pose; leading dimensions broadcast."""
    return points @ pose[..., :3, :3].transpose(-1, -2) + pose[..., None, :3, 3]


def rotation_between(
    source: Tensor,  # [..., 3] unit
    target: Tensor,  # [..., 3] unit
) -> Tensor:  # [..., 3, 3]
    """The smallest rotation that turns `source` onto `target`; some rotation where they are opposite.

    Half a turn about the source, then half a turn about the bisector.
    """

    def half_turn(axis: Tensor) -> Tensor:
        return 2 * axis[..., :, None] * axis[..., None, :] - torch.eye(3).to(axis)

    return half_turn(functional.normalize(source + target, dim=-1)) @ half_turn(source)
