"""Screw motions: what a revolute or prismatic joint does.

Convention:
    Angles are radians, displacements are in the units of the points. A positive revolute state turns counter-clockwise
    seen from the tip of the axis (right-hand rule).
"""

from __future__ import annotations

import torch
from torch import Tensor

from articulate_ssl.geometry.se3 import se3

REVOLUTE = 0
PRISMATIC = 1


def axis_angle_to_rotation(
    axis: Tensor,  # [..., 3], unit length
    angle: Tensor,  # [...], radians
) -> Tensor:  # [..., 3, 3]
    """Rotation by `angle` about `axis`, by Rodrigues' formula; smooth, NaN-free gradients at angle zero.

    roma's, which takes rotation vectors, has the length of the axis to find first. Every pose of every hypothesis is
    made here: with it, a fourth of all that a GPU was asked to do for one cloud was this function.
    """
    identity = torch.eye(3, dtype=axis.dtype, device=axis.device)
    # Row i is axis x e_i; the transpose crosses the axis with a column.
    cross = torch.linalg.cross(axis[..., None, :], identity.expand(*axis.shape, 3), dim=-1).mT
    sine, rest = angle.sin()[..., None, None], (1 - angle.cos())[..., None, None]
    return identity + sine * cross + rest * (cross @ cross)


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
