import pytest
import roma
import torch

from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE, screw_motion
from articulate_ssl.geometry.se3 import se3, transform_points
from articulate_ssl.shape.part_poses import joint_states, nearest_on_line, rigid_fit


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
