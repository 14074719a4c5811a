"""Predictions with a known truth, made of boxes."""

import numpy as np
import torch
import trimesh

from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from articulate_ssl.geometry.se3 import se3, transform_points
from articulate_ssl.inference.articulation import part_motion
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.ops.farthest_point import farthest_point_order


def random_rotation(seed: int) -> torch.Tensor:
    q, r = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(seed)))
    q = q * r.diagonal().sign()
    return q * torch.linalg.det(q)


def box_points(extents, center, count: int, seed: int) -> torch.Tensor:
    mesh = trimesh.creation.box(extents, trimesh.transformations.translation_matrix(center))
    points = np.asarray(trimesh.sample.sample_surface(mesh, 4 * count, seed=seed)[0])
    return torch.as_tensor(points[farthest_point_order(points, count)], dtype=torch.float32)


def chain_of_boxes(boxes, joints, states, num_points=512, shape_points=256, seed=0):
    """One cloud and its perfect prediction.

    Args:
        boxes: K pairs (extents, centre) in canonical object space; part 0 is the base.
        joints: (type, parent, child, axis, pivot) each, in canonical object space.

    Returns:
        Prediction (B = 1) and the points [num_points, 3] it belongs to.
    """
    shapes = torch.stack([box_points(e, (0, 0, 0), shape_points, seed + k) for k, (e, _) in enumerate(boxes)])
    assembly = torch.tensor([c for _, c in boxes], dtype=torch.float32)
    axis, pivot = (torch.tensor([j[i] for j in joints], dtype=torch.float32).reshape(-1, 3) for i in (3, 4))
    joint_type, parent, child = (torch.tensor([j[i] for j in joints], dtype=torch.int64) for i in range(3))
    base_pose = se3(random_rotation(seed), torch.tensor([0.05, -0.02, 0.03]))
    incomplete = dict(
        part_shape=shapes[None],
        assembly=assembly[None],
        base_pose=base_pose[None],
        joint_parent=parent[None],
        joint_child=child[None],
        joint_type=joint_type[None],
        joint_state=torch.tensor([states], dtype=torch.float32),
        canonical_axis=axis[None],
        canonical_pivot=pivot[None],
        reconstruction_error=torch.tensor([0.012]),
        margin=torch.tensor([0.4]),
    )
    unknown = dict.fromkeys(("part_id", "part_probability", "joint_axis", "joint_pivot"), torch.zeros(1, 1))
    unknown["part_pose"] = torch.zeros(1, len(boxes), 4, 4)
    motion = part_motion(Prediction(**incomplete, **unknown), incomplete["joint_state"])[0]
    part_pose = base_pose @ motion @ se3(torch.eye(3).expand(len(boxes), 3, 3), assembly)
    moving = base_pose @ motion[parent]
    count = num_points // len(boxes) + 1
    dense = torch.stack([box_points(e, (0, 0, 0), count, seed + 50 + k) for k, (e, _) in enumerate(boxes)])
    part_id = torch.arange(len(boxes)).repeat_interleave(count)[:num_points]
    prediction = Prediction(
        **incomplete,
        part_id=part_id[None],
        part_probability=torch.nn.functional.one_hot(part_id, len(boxes)).float()[None],
        part_pose=part_pose[None],
        joint_axis=(moving[:, :3, :3] @ axis[..., None]).squeeze(-1)[None],
        joint_pivot=transform_points(moving, pivot[:, None])[:, 0][None],
    )
    return prediction, transform_points(part_pose, dense).reshape(-1, 3)[:num_points]


def laptop(angle=1.2, seed=0, points=512):
    """Base and lid, hinge at the back along x; the canonical object is closed."""
    boxes = [((0.8, 0.55, 0.04), (0, 0, 0)), ((0.8, 0.55, 0.03), (0, 0, 0.04))]
    return chain_of_boxes(boxes, [(REVOLUTE, 0, 1, (-1.0, 0, 0), (0, 0.275, 0.02))], [angle], points, seed=seed)


def drawer(states=(0.2, 0.1, 0.0), seed=0):
    """Body and three drawers that slide along -y."""
    boxes = [((0.5, 0.5, 0.65), (0, 0, 0))] + [((0.4, 0.45, 0.16), (0, -0.06, 0.2 * i)) for i in (1, 0, -1)]
    joints = [(PRISMATIC, 0, k, (0, -1.0, 0), (0, -0.06, 0.2 * (2 - k))) for k in (1, 2, 3)]
    return chain_of_boxes(boxes, joints, list(states), seed=seed)


def arm(seed=0):
    """A chain of mixed joints: 2 - 1 - 0, with the base in the middle of the part numbering swapped."""
    boxes = [((0.4, 0.1, 0.1), (0, 0, 0)), ((0.3, 0.1, 0.08), (0.35, 0, 0)), ((0.2, 0.06, 0.06), (0.6, 0, 0))]
    joints = [(REVOLUTE, 0, 1, (0, 0, 1.0), (0.2, 0, 0)), (PRISMATIC, 1, 2, (0, 0.6, 0.8), (0.5, 0, 0))]
    return chain_of_boxes(boxes, joints, [0.7, 0.15], seed=seed)
