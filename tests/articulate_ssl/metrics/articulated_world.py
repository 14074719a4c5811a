"""Labelled clouds of well-separated parts, and a network right up to everything that no label-free one can know."""

from __future__ import annotations

from dataclasses import replace

import roma
import torch
from torch import Tensor

from articulate_ssl.geometry.kinematic_chain import forward_kinematics
from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE, screw_motion
from articulate_ssl.geometry.se3 import invert_se3, se3, transform_points
from articulate_ssl.inference.prediction import Prediction

CHAIN, STAR = "chain", "star"
DOUBLE = torch.float64


def articulated_labels(
    clouds: int = 24,
    num_parts: int = 3,
    joint_types: tuple[int, ...] | None = None,
    tree: str = CHAIN,
    instances: int = 4,
    points: int = 60,
    dense: int = 180,
    seed: int = 0,
) -> dict[str, Tensor]:
    """Batch of clouds whose parts are 0.05 small and 0.4 apart; instances differ in where their parts sit."""
    g = torch.Generator().manual_seed(seed)
    J = num_parts - 1
    joint_types = joint_types or (REVOLUTE,) * J
    parent = [0] * J if tree == STAR else list(range(J))
    child = list(range(1, num_parts))
    category = torch.Generator().manual_seed(1234)
    step = torch.tensor([0.4, 0.1, 0.05], dtype=DOUBLE)
    axis = torch.nn.functional.normalize(torch.randn(J, 3, generator=category, dtype=DOUBLE), dim=-1)
    instance = torch.arange(clouds) % instances
    shift = 0.01 * torch.randn(instances, num_parts, 3, generator=g, dtype=DOUBLE)
    center = (torch.arange(num_parts)[:, None] * step + shift)[instance]  # [S, K, 3]
    pivot = (center[:, parent] + center[:, child]) / 2
    state = 1.4 * torch.rand(clouds, J, generator=g, dtype=DOUBLE) - 0.5
    motions = [screw_motion(axis[j].expand(clouds, 3), pivot[:, j], state[:, j], joint_types[j]) for j in range(J)] or [
        torch.empty(clouds, 0, 4, 4, dtype=DOUBLE)
    ]
    motion = torch.stack(motions, dim=1) if J else motions[0]
    quaternion = torch.nn.functional.normalize(torch.randn(clouds, 4, generator=g, dtype=DOUBLE), dim=-1)
    offset = 0.1 * torch.randn(clouds, 3, generator=g, dtype=DOUBLE)
    pose = se3(roma.unitquat_to_rotmat(quaternion), offset)[:, None] @ forward_kinematics(
        motion, parent, child, num_parts
    )
    part_id = torch.arange(dense).remainder(num_parts).expand(clouds, dense)
    rows = torch.arange(clouds)[:, None]
    rest = center[rows, part_id] + 0.05 * (torch.rand(clouds, dense, 3, generator=g, dtype=DOUBLE) - 0.5)
    dense_points = transform_points(pose[rows, part_id], rest[:, :, None]).squeeze(2)
    of_parent = pose[:, parent]
    labels = {
        "points": dense_points[:, :points],
        "dense_points": dense_points,
        "dense_part_id": part_id,
        "part_pose": pose,
        "part_center": center,
        "joint_axis": (of_parent[..., :3, :3] @ axis[..., None]).squeeze(-1),
        "joint_pivot": transform_points(of_parent, pivot[:, :, None]).squeeze(2),
        "joint_state": state,
        "joint_parent": torch.tensor(parent, dtype=torch.long).expand(clouds, J),
        "joint_child": torch.tensor(child, dtype=torch.long).expand(clouds, J),
        "joint_type": torch.tensor(joint_types, dtype=torch.long).expand(clouds, J),
        "instance": instance,
        "scale": torch.ones(clouds, dtype=DOUBLE),
    }
    return {name: v.float() if v.is_floating_point() else v.contiguous() for name, v in labels.items()}


def disguise(
    prediction: Prediction,
    seed: int = 0,
) -> tuple[Prediction, Tensor]:  # prediction, [K] the slot of every part
    """The same prediction in a network's own terms.

    Slots are permuted, every canonical part space is moved by its own arbitrary rigid motion, joints are listed in
    another order, every second one is called the other way round (parent and child), axes point the other way, and
    states count from another zero.
    """
    g = torch.Generator().manual_seed(seed)
    K, J = prediction.num_parts, prediction.joint_state.shape[1]
    part_of_slot, order = torch.randperm(K, generator=g), torch.randperm(J, generator=g)
    slot_of_part = part_of_slot.argsort()
    quaternion = torch.nn.functional.normalize(torch.randn(K, 4, generator=g), dim=-1)
    space = se3(roma.unitquat_to_rotmat(quaternion), torch.randn(K, 3, generator=g))
    swapped = (torch.arange(J) % 2).bool()
    axis_sign = torch.where(torch.rand(J, generator=g) < 0.5, -1.0, 1.0)
    state_sign = axis_sign * torch.where(swapped, -1.0, 1.0)
    offset = torch.randn(J, generator=g)
    parent, child = slot_of_part[prediction.joint_parent], slot_of_part[prediction.joint_child]
    return (
        replace(
            prediction,
            part_id=slot_of_part[prediction.part_id],
            part_probability=prediction.part_probability[..., part_of_slot],
            part_pose=prediction.part_pose[:, part_of_slot] @ space,
            part_shape=transform_points(invert_se3(space), prediction.part_shape[:, part_of_slot]),
            assembly=prediction.assembly[:, part_of_slot],
            joint_parent=torch.where(swapped, child, parent)[:, order],
            joint_child=torch.where(swapped, parent, child)[:, order],
            joint_type=prediction.joint_type[:, order],
            joint_axis=(prediction.joint_axis * axis_sign[:, None])[:, order],
            # Any point of the joint line will do.
            joint_pivot=(prediction.joint_pivot + 0.7 * prediction.joint_axis)[:, order],
            joint_state=(state_sign * prediction.joint_state + offset)[:, order],
        ),
        slot_of_part,
    )


def part_turn(
    prediction: Prediction,
    degrees: float | Tensor,  # or [B]
    part: int,
) -> Prediction:
    """The prediction with one part turned about its canonical x axis."""
    clouds = len(prediction.part_pose)
    angle = torch.deg2rad(torch.as_tensor(degrees, dtype=DOUBLE)).expand(clouds)
    vector = torch.zeros(clouds, 3, dtype=DOUBLE)
    vector[:, 0] = angle
    turn = se3(roma.rotvec_to_rotmat(vector), torch.zeros(clouds, 3, dtype=DOUBLE))
    pose = prediction.part_pose.double().clone()
    pose[:, part] = pose[:, part] @ turn
    return replace(prediction, part_pose=pose)


__all__ = ["CHAIN", "PRISMATIC", "REVOLUTE", "STAR", "articulated_labels", "disguise", "part_turn"]
