import pytest
import roma
import torch

from articulate_ssl.baselines.part_coordinates import joint_states, nearest_on_line, ransac_poses, rigid_fit
from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE, screw_motion
from articulate_ssl.geometry.se3 import se3, transform_points


def poses(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    quaternion = torch.randn(count, 4, generator=generator)
    rotation = roma.unitquat_to_rotmat(quaternion / quaternion.norm(dim=-1, keepdim=True))
    return se3(rotation, torch.randn(count, 3, generator=generator))


def test_a_rigid_fit_is_exact_and_never_a_reflection():
    torch.manual_seed(0)
    source, pose = torch.randn(5, 30, 3), poses(5)
    fitted = rigid_fit(source, transform_points(pose, source), torch.rand(5, 30))
    torch.testing.assert_close(fitted, pose, atol=1e-4, rtol=0)
    mirrored = rigid_fit(source, source * torch.tensor([-1.0, 1, 1]), torch.ones(5, 30))
    torch.testing.assert_close(torch.linalg.det(mirrored[:, :3, :3]), torch.ones(5))


def test_ransac_survives_a_third_of_outliers_and_points_of_other_parts():
    torch.manual_seed(0)
    coordinates, pose = 0.3 * torch.randn(3, 2, 90, 3), poses(6).view(3, 2, 4, 4)
    part_id = torch.arange(90) % 2
    posed = transform_points(pose, coordinates)
    points = posed.gather(1, part_id.expand(3, -1)[:, None, :, None].expand(-1, -1, -1, 3)).squeeze(1)
    wrong = coordinates.clone()
    wrong[:, :, ::3] += torch.randn(3, 2, 30, 3)
    weight = torch.nn.functional.one_hot(part_id, 2).T.float().expand(3, -1, -1)
    torch.testing.assert_close(ransac_poses(wrong, points, weight), pose, atol=1e-3, rtol=0)
    least_squares = rigid_fit(wrong, points[:, None].expand(-1, 2, -1, -1), weight)
    assert (least_squares - pose).abs().max() > 0.1


def test_a_part_without_points_has_a_finite_pose():
    points = torch.randn(2, 40, 3)
    weight = torch.stack([torch.ones(2, 40), torch.zeros(2, 40)], dim=1)
    assert ransac_poses(torch.zeros(2, 2, 40, 3), points, weight).isfinite().all()


@pytest.mark.parametrize("joint_type", [REVOLUTE, PRISMATIC])
def test_states_are_those_that_moved_the_children(joint_type):
    torch.manual_seed(0)
    axis = torch.nn.functional.normalize(torch.randn(4, 1, 3), dim=-1)
    center, state, base = torch.randn(4, 2, 3), torch.tensor([[-1.2], [0.0], [0.4], [1.5]]), poses(4)
    moved = base @ screw_motion(axis[:, 0], torch.randn(4, 3), state[:, 0], joint_type)
    identity = torch.eye(3).expand(4, 3, 3)
    pose = torch.stack([base @ se3(identity, center[:, 0]), moved @ se3(identity, center[:, 1])], dim=1)
    found = joint_states(pose, center, axis, torch.tensor([0]), torch.tensor([1]), joint_type)
    torch.testing.assert_close(found, state, atol=1e-4, rtol=0)
    turned = poses(1, seed=1)[:, None] @ pose
    again = joint_states(turned, center, axis, torch.tensor([0]), torch.tensor([1]), joint_type)
    torch.testing.assert_close(again, state, atol=1e-4, rtol=0)


def test_the_nearest_pivot_does_not_depend_on_which_pivot_is_given():
    torch.manual_seed(0)
    axis = torch.nn.functional.normalize(torch.randn(6, 3), dim=-1)
    pivot = torch.randn(6, 3)
    nearest = nearest_on_line(pivot, axis)
    torch.testing.assert_close(nearest_on_line(pivot + 2.5 * axis, axis), nearest, atol=1e-5, rtol=0)
    assert (nearest.norm(dim=-1) <= pivot.norm(dim=-1) + 1e-6).all()
