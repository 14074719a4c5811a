"""Pose-aware convolution against the paper's Eq. 2 taken literally."""

import pytest
import roma
import torch

from articulate_ssl.geometry.equivariance import TOLERANCE, Permutation, assert_part_equivariant
from articulate_ssl.geometry.kernel_points import symmetric_kernel_points
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.geometry.se3 import se3, transform_points
from articulate_ssl.network.backbone import EquivariantBackbone
from articulate_ssl.network.pose_aware_convolution import (
    canonicalize,
    pose_aware_convolution,
    to_camera_frame,
    to_canonical_frame,
)
from articulate_ssl.ops import reference
from articulate_ssl.ops.group_convolution import group_convolution
from articulate_ssl.ops.neighborhood import build_neighborhood


def _articulated_cloud(rotation, num_points=48):
    """Two parts of a canonical cloud, each under its own pose: points, poses per point and part ids."""
    canonical = 0.4 * torch.rand(1, num_points, 3, dtype=torch.float64)
    part_id = torch.arange(num_points)[None] % 2
    poses = se3(rotation, torch.randn(2, 3, dtype=torch.float64))[part_id]
    return transform_points(poses, canonical[..., None, :]).squeeze(-2), poses, part_id, canonical


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("order", [12, 24, 60])
def test_equals_the_literal_sum_for_group_rotations(order, dtype):
    group = rotation_group(order)
    kernel = symmetric_kernel_points(group)
    points, poses, _, _ = _articulated_cloud(group.elements[torch.randint(order, (2,))])
    features = torch.randn(1, 48, order, 3, dtype=dtype)
    weight = torch.randn(24, 3, 4, dtype=dtype)
    arguments = (features, points.to(dtype), poses.to(dtype), weight, group, kernel, 0.25, 12)
    fast, literal = pose_aware_convolution(*arguments), reference.pose_aware_convolution(*arguments)
    assert (fast - literal).norm() / literal.norm() < TOLERANCE[dtype]


def test_identity_poses_give_plain_group_convolution():
    group = rotation_group(60)
    kernel = symmetric_kernel_points(group)
    points = 0.4 * torch.rand(1, 30, 3, dtype=torch.float64)
    features = torch.randn(1, 30, 60, 3, dtype=torch.float64)
    weight = torch.randn(24, 3, 4, dtype=torch.float64)
    poses = torch.eye(4, dtype=torch.float64).expand(1, 30, 4, 4)
    plain = group_convolution(features, build_neighborhood(points, 0.25, kernel.points, 12), weight, kernel.permutation)
    for function in (pose_aware_convolution, reference.pose_aware_convolution):
        posed = function(features, points, poses, weight, group, kernel, 0.25, 12)
        torch.testing.assert_close(posed, plain, rtol=1e-9, atol=1e-9)


def test_camera_and_canonical_frames_are_inverse():
    group = rotation_group(24)
    _, poses, _, _ = _articulated_cloud(roma.random_rotmat(2, dtype=torch.float64))
    features = torch.randn(1, 48, 24, 3, dtype=torch.float64)
    torch.testing.assert_close(to_canonical_frame(to_camera_frame(features, poses, group), poses, group), features)


def test_canonicalize_undoes_the_poses():
    points, poses, _, canonical = _articulated_cloud(roma.random_rotmat(2, dtype=torch.float64))
    torch.testing.assert_close(canonicalize(points, poses), canonical)


@pytest.mark.parametrize("order", [12, 60])
def test_a_part_that_moves_turns_its_own_features_and_no_others(order):
    torch.manual_seed(0)
    group = rotation_group(order)
    kernel = symmetric_kernel_points(group)
    rotation, middle = group.elements[torch.randint(order, (2,))], torch.full((3, 1), 0.2, dtype=torch.float64)
    part_id = torch.arange(48)[None] % 2
    poses = se3(rotation, (middle - rotation @ middle).squeeze(-1))[part_id]  # parts interpenetrate, and stay so
    canonical = 0.4 * torch.rand(1, 48, 3, dtype=torch.float64)
    points = transform_points(poses, canonical[..., None, :]).squeeze(-2)
    features = torch.randn(1, 48, order, 3, dtype=torch.float64)
    weight = torch.randn(24, 3, 4, dtype=torch.float64)
    element = 5
    motion = se3(group.elements[element], torch.randn(3, dtype=torch.float64))
    mine = part_id[0] == 1

    def move(points, poses, features):
        points, poses, features = points.clone(), poses.clone(), features.clone()
        points[:, mine] = transform_points(motion, points[:, mine])
        poses[:, mine] = motion @ poses[:, mine]
        features[:, mine] = Permutation()(features[:, mine], group, element)
        return points, poses, features

    def error(layer) -> float:
        before = layer(features, points, poses)
        moved_points, moved_poses, moved_features = move(points, poses, features)
        after = layer(moved_features, moved_points, moved_poses)
        _, _, expected = move(points, poses, before)
        return ((after - expected).norm() / expected.norm()).item()

    def pose_aware(features, points, poses):
        return pose_aware_convolution(features, points, poses, weight, group, kernel, 0.25, 12)

    def blind(features, points, poses):
        return pose_aware(features, points, torch.eye(4, dtype=torch.float64).expand_as(poses))

    assert error(pose_aware) < 1e-9
    assert error(blind) > 1e-2


@pytest.fixture(params=[False, True], ids=["full", "separable"])
def backbone(request):
    torch.manual_seed(0)
    return EquivariantBackbone(12, (4, 6), (0.2, 0.3), num_neighbors=10, separable=request.param)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_features_ignore_the_motion_of_parts_whose_pose_is_given(backbone, dtype):
    points, poses, part_id, canonical = _articulated_cloud(roma.random_rotmat(2, dtype=torch.float64))
    backbone = backbone.to(dtype)
    with torch.no_grad():
        assert_part_equivariant(backbone, points.to(dtype), poses.to(dtype), part_id)
        torch.testing.assert_close(backbone(points.to(dtype), poses.to(dtype)), backbone(canonical.to(dtype)))


def test_neighbourhoods_in_camera_space_are_caught(backbone):
    points, poses, part_id, _ = _articulated_cloud(roma.random_rotmat(2, dtype=torch.float64))
    with torch.no_grad(), pytest.raises(AssertionError, match="not part-level equivariant"):
        assert_part_equivariant(lambda points, poses: backbone.double()(points), points, poses, part_id)
