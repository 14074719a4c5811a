"""Poses compose, invert and act on points."""

import math

import roma
import torch
from rigid_motions import DTYPE, random_pose, unit
from torch.nn.functional import normalize
from torch.testing import assert_close

from articulate_ssl.geometry.screw import axis_angle_to_rotation
from articulate_ssl.geometry.se3 import invert_se3, rotation_between, se3, transform_points


def test_se3_broadcasts_and_acts_on_column_vectors():
    rotation = axis_angle_to_rotation(unit(0, 0, 1), torch.tensor(math.pi / 2, dtype=DTYPE))
    pose = se3(rotation, torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], dtype=DTYPE))
    assert pose.shape == (2, 4, 4)
    moved = pose @ torch.tensor([1.0, 0.0, 0.0, 1.0], dtype=DTYPE)
    assert_close(moved, torch.tensor([[1.0, 3.0, 3.0, 1.0], [4.0, 6.0, 6.0, 1.0]], dtype=DTYPE))


def test_invert_se3_is_the_matrix_inverse():
    pose = random_pose(2, 5)
    assert_close(invert_se3(pose), torch.linalg.inv(pose))


def test_transform_points_broadcasts_over_parts():
    pose, points = random_pose(2, 3), torch.randn(2, 1, 7, 3, dtype=DTYPE)
    homogeneous = torch.cat([points, torch.ones_like(points[..., :1])], -1)
    expected = torch.einsum("bkij,blnj->bkni", pose, homogeneous)[..., :3]
    assert_close(transform_points(pose, points), expected)


def test_rotation_between_is_the_smallest_one_also_for_equal_directions():
    source, target = normalize(torch.randn(2, 20, 3, dtype=torch.float64), dim=-1)
    target[0] = source[0]
    rotation = rotation_between(source, target)
    assert_close(torch.einsum("nij,nj->ni", rotation, source), target)
    angle = roma.rotmat_geodesic_distance(rotation, torch.eye(3, dtype=torch.float64).expand(20, 3, 3))
    assert_close(angle.cos(), (source * target).sum(-1))
