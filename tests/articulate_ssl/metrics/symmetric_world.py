"""Labelled clouds of objects made of boxes, whose symmetries are known."""

from __future__ import annotations

import roma
import torch
from torch import Tensor

from articulate_ssl.geometry.kinematic_chain import forward_kinematics
from articulate_ssl.geometry.screw import REVOLUTE, screw_motion
from articulate_ssl.geometry.se3 import se3, transform_points

DOUBLE = torch.float64
UP = (0.0, 1.0, 0.0)
BODY = ((0.0, 0.0, 0.0), (0.7, 0.3, 0.5))  # centre, size
# On top of the body; turned about the vertical through its middle, it is in the way of no half turn about it.
TURNTABLE = ((0.0, 0.2, 0.0), (0.4, 0.04, 0.2))
HANDLE = ((0.0, 0.0, 0.27), (0.1, 0.03, 0.04))  # on the body's front, 0.9 % of its surface, 4 % of the diagonal high

Box = tuple[tuple[float, float, float], tuple[float, float, float]]


def box_points(count: int, boxes: list[Box], generator: torch.Generator) -> Tensor:  # [count, 3]
    """Points on the boxes, uniform by area."""
    center, size = (torch.tensor([box[i] for box in boxes], dtype=DOUBLE) for i in range(2))
    area = size.prod(-1, keepdim=True) / size  # [boxes, 3], of the faces across each axis
    face = torch.multinomial(area.flatten(), count, replacement=True, generator=generator)
    box, axis = face // 3, face % 3
    unit = torch.rand(count, 3, generator=generator, dtype=DOUBLE) - 0.5
    unit[torch.arange(count), axis] = (torch.rand(count, generator=generator, dtype=DOUBLE) < 0.5).double() - 0.5
    return center[box] + unit * size[box]


def surface_area(boxes: list[Box]) -> float:
    """Of all boxes."""
    return sum(2 * (a * b + b * c + c * a) for _, (a, b, c) in boxes)


def box_labels(
    parts: list[list[Box]],  # K parts of boxes
    pivots: tuple[tuple[float, float, float], ...] = (),  # of the hinges between part 0 and the others
    clouds: int = 16,
    instances: int = 2,
    dense: int = 4096,
    seed: int = 0,
    axis: tuple[float, float, float] = UP,
    states: float = 1.0,  # radians at most
) -> dict[str, Tensor]:
    """Clouds of one shape in random poses and states, as if from `instances` instances; centres are of first boxes."""
    g = torch.Generator().manual_seed(seed)
    K, J = len(parts), len(pivots)
    axis, pivot = torch.tensor(axis, dtype=DOUBLE), torch.tensor(pivots, dtype=DOUBLE).reshape(J, 3)
    state = states * torch.rand(clouds, J, generator=g, dtype=DOUBLE)
    motion = torch.empty(clouds, J, 4, 4, dtype=DOUBLE)
    for j in range(J):
        motion[:, j] = screw_motion(axis.expand(clouds, 3), pivot[j].expand(clouds, 3), state[:, j], REVOLUTE)
    quaternion = torch.nn.functional.normalize(torch.randn(clouds, 4, generator=g, dtype=DOUBLE), dim=-1)
    base = se3(roma.unitquat_to_rotmat(quaternion), torch.randn(clouds, 3, generator=g, dtype=DOUBLE))[:, None]
    pose = base @ forward_kinematics(motion, [0] * J, list(range(1, K)), K)
    area = torch.tensor([surface_area(boxes) for boxes in parts], dtype=DOUBLE)
    part_id = torch.multinomial(area.expand(clouds, K), dense, replacement=True, generator=g)
    rest = torch.empty(clouds, dense, 3, dtype=DOUBLE)
    for k, boxes in enumerate(parts):
        own = part_id == k
        rest[own] = box_points(int(own.sum()), boxes, g)
    rows = torch.arange(clouds)[:, None]
    points = transform_points(pose[rows, part_id], rest[:, :, None]).squeeze(2)
    labels = {
        "points": points[:, :64],
        "dense_points": points,
        "dense_part_id": part_id,
        "part_pose": pose,
        "part_center": torch.tensor([boxes[0][0] for boxes in parts], dtype=DOUBLE).expand(clouds, K, 3),
        "joint_axis": (base[..., :3, :3] @ axis[:, None]).squeeze(-1).expand(clouds, J, 3),
        "joint_pivot": transform_points(base[:, 0], pivot.expand(clouds, J, 3)),
        "joint_state": state,
        "joint_parent": torch.zeros(clouds, J, dtype=torch.long),
        "joint_child": torch.arange(1, K).expand(clouds, J),
        "joint_type": torch.full((clouds, J), REVOLUTE),
        "instance": torch.arange(clouds) % instances,
        "scale": torch.ones(clouds, dtype=DOUBLE),
    }
    return {name: v.float() if v.is_floating_point() else v.contiguous() for name, v in labels.items()}


def turned_about(axis: str, degrees: float) -> Tensor:  # [3, 3]
    """Rotation about x, y or z."""
    vector = torch.zeros(3, dtype=DOUBLE)
    vector["xyz".index(axis)] = torch.pi * degrees / 180
    return roma.rotvec_to_rotmat(vector)
