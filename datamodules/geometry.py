"""Rigid motions shared by data generation and method: SE(3), screw motions, forward kinematics.

Convention:
    Poses are 4x4 matrices acting on column vectors. Angles are radians, displacements are in the units of the points.
    A positive revolute state turns counter-clockwise seen from the tip of the axis (right-hand rule).
"""

from __future__ import annotations

from collections.abc import Sequence

import roma
import torch
from torch import Tensor

REVOLUTE = 0
PRISMATIC = 1


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


def axis_angle_to_rotation(
    axis: Tensor,  # [..., 3], unit length
    angle: Tensor,  # [...], radians
) -> Tensor:  # [..., 3, 3]
    """Rotation by `angle` about `axis`; smooth, NaN-free gradients at angle zero."""
    return roma.rotvec_to_rotmat(axis * angle[..., None])


def screw_motion(
    axis: Tensor,  # [..., 3], unit length
    pivot: Tensor,  # [..., 3], a point on the joint line
    state: Tensor,  # [...], radians or displacement
    joint_type: int,
) -> Tensor:  # [..., 4, 4]
    """Motion of a joint by `state`: rotation about the line (pivot, axis), or translation along the axis.

    Raises:
        ValueError: if `joint_type` is neither `REVOLUTE` nor `PRISMATIC`.
    """
    if joint_type == REVOLUTE:
        rotation = axis_angle_to_rotation(axis, state)
        return se3(rotation, pivot - (rotation @ pivot[..., None]).squeeze(-1))
    if joint_type == PRISMATIC:
        identity = torch.eye(3, dtype=axis.dtype, device=axis.device)
        return se3(identity, axis * state[..., None])
    raise ValueError(f"joint_type must be {REVOLUTE} (revolute) or {PRISMATIC} (prismatic), got {joint_type}")


def forward_kinematics(
    motion: Tensor,  # [..., J, 4, 4], each joint's own motion in the object frame at rest
    parent: Sequence[int],  # J part indices
    child: Sequence[int],  # J part indices, each part at most once
    num_parts: int,
) -> Tensor:  # [..., K, 4, 4]
    """Cascaded articulation: the motion of every part when joints act one after another from the root outwards.

    A part's motion is its parent's motion times its own joint's motion, so axes and pivots are all stated in the
    object frame at rest. Parts that no joint moves stay put.

    Raises:
        ValueError: if the joints do not form a forest (a part with two parents, or a cycle).
    """
    if len(set(child)) != len(child):
        raise ValueError(f"a part has two parents: child parts are {list(child)}")
    identity = torch.eye(4, dtype=motion.dtype, device=motion.device).expand(*motion.shape[:-3], 4, 4)
    joint_of = {c: j for j, c in enumerate(child)}
    pose: dict[int, Tensor] = {}

    def resolve(part: int, path: tuple[int, ...]) -> Tensor:
        if part in path:
            raise ValueError(f"the kinematic tree has a cycle through parts {[*path, part]}")
        if part not in pose:
            j = joint_of.get(part)
            pose[part] = identity if j is None else resolve(parent[j], (*path, part)) @ motion[..., j, :, :]
        return pose[part]

    return torch.stack([resolve(part, ()) for part in range(num_parts)], dim=-3)
