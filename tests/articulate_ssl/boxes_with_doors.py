"""Boxes with something on their top and a hinged door, as scans and as predictions, some of which lie on their side."""

import math

import roma
import torch

from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.geometry.screw import REVOLUTE, screw_motion
from articulate_ssl.geometry.se3 import se3, transform_points
from articulate_ssl.inference.hinge_sides import BODY_SIZE, HingeSides
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.network.surface_network import SurfaceSize
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.joints import Joints

QUARTER = math.pi / 2
ZERO = -1.9  # joint state at which the door is closed
HINGE, PIVOT = torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 0.3, -0.26])  # opens outwards
BODY, DOOR = torch.tensor([0.6, 0.6, 0.5]), torch.tensor([0.6, 0.6, 0.02])


def on_box(size: torch.Tensor, count: int, generator: torch.Generator) -> torch.Tensor:
    """Points [count, 3] on the surface of a box about the origin."""
    points = torch.rand(count, 3, generator=generator) - 0.5
    side = torch.arange(count) % 3
    rows = torch.arange(count)
    points[rows, side] = points[rows, side].sign() / 2
    return points * size


def box_parts(generator: torch.Generator, count: int, up: int = 1) -> tuple[torch.Tensor, torch.Tensor]:
    """Points of the body, with something on its top (+y, or +x), and of the closed door at its front (-z)."""
    place, size = torch.tensor([0.0, 0.34, 0.1]), torch.tensor([0.3, 0.08, 0.2])
    order = [1, 0, 2] if up == 0 else [0, 1, 2]
    top = place[order] + on_box(size[order], count // 5, generator)
    body = torch.cat([on_box(BODY, count - count // 5, generator), top])
    return body, on_box(DOOR, count // 3, generator) + torch.tensor([0.0, 0.0, -0.26])


def box_shape() -> ArticulatedShape:
    body, door = box_parts(torch.Generator().manual_seed(0), 600)
    opened = screw_motion(HINGE, PIVOT, torch.tensor(-ZERO), REVOLUTE)
    points = torch.cat([body, transform_points(opened, door)])
    label = torch.tensor([0] * len(body) + [1] * len(door))
    joints = Joints(KinematicChain(2, 0, (0,), (1,)), HINGE[None], PIVOT[None], REVOLUTE)
    return ArticulatedShape(points, label, joints)


def box_sides() -> HingeSides:
    sides = HingeSides()
    # Seen in training with the door open by 50 to 100 degrees.
    sides.measure(box_shape(), torch.tensor([[ZERO + 0.9, ZERO + 1.8]]))
    return sides


class TopIsUp(torch.nn.Module):
    """Looks right to it what has more above: its mean, where points count from, is nearer to its upper end."""

    def __init__(self, up: int = 1, size: SurfaceSize = BODY_SIZE):
        super().__init__()
        self.size = size
        self.up = up
        self.register_buffer("temperature", torch.tensor(1.0))

    def seen(self, cloud):
        up = cloud.points[..., self.up]
        return -2000 * (up.amax(dim=1) + up.amin(dim=1))


def lying_boxes(
    quarters: list[int],  # by which the frame of each of B objects is to be turned
    opened: float = 1.2,
    up: int = 1,
    knob: bool = False,  # at the upper end of the door, +x
) -> tuple[Prediction, torch.Tensor, torch.Tensor]:
    """Predictions by the one joint there is, dense clouds, and the true rotations canonical -> camera."""
    generator, shape = torch.Generator().manual_seed(3), box_shape()
    count = len(quarters)
    body, door = box_parts(generator, 3000, up)
    if knob:
        at = torch.tensor([0.2, 0.0, -0.28])
        door = torch.cat([door, at + on_box(torch.tensor([0.1, 0.1, 0.02]), 300, generator)])
    base = se3(roma.random_rotmat(count), torch.rand(count, 3, generator=generator))
    state = torch.full((count, 1), ZERO + opened)
    sides = box_sides()
    turn = roma.rotvec_to_rotmat(torch.tensor(quarters)[:, None] * QUARTER * sides.axes[:, 2])
    motion = screw_motion(HINGE, PIVOT, torch.tensor(opened), REVOLUTE)
    dense = torch.cat([body @ turn.mT, transform_points(motion, door @ turn.mT)], dim=1)
    dense = transform_points(base, dense[:, torch.randperm(dense.shape[1], generator=generator)])
    rest = shape.points.view(1, -1, 3)
    parts = [rest[:, shape.label == k][:, :200].expand(count, -1, -1) for k in range(2)]
    center = torch.stack([part.mean(dim=1) for part in parts], dim=1)
    pose = shape.joints.part_pose(base, state)
    part_pose = pose.clone()
    part_pose[..., :3, 3] = transform_points(pose, center[:, :, None])[:, :, 0]
    line = torch.zeros(count, 1, dtype=torch.long)
    prediction = Prediction(
        part_id=torch.zeros(count, 4, dtype=torch.long),
        part_probability=torch.ones(count, 4, 2) / 2,
        part_pose=part_pose,
        part_shape=torch.stack(parts, dim=1) - center[:, :, None],
        assembly=center,
        base_pose=base,
        joint_parent=line,
        joint_child=line + 1,
        joint_type=line,
        joint_axis=(base[:, None, :3, :3] @ HINGE[:, None]).squeeze(-1),
        joint_pivot=transform_points(base, PIVOT.expand(count, 1, 3)),
        joint_state=state,
        canonical_axis=HINGE.expand(count, 1, 3),
        canonical_pivot=PIVOT.expand(count, 1, 3),
        reconstruction_error=torch.ones(count),
        margin=torch.ones(count),
    )
    return prediction, dense, base[:, :3, :3] @ turn
