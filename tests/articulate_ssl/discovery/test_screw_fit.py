"""A joint is recovered from relative poses, some of them wrong."""

import math

import pytest
import roma
import torch
from torch.nn.functional import normalize

from articulate_ssl.discovery.screw_fit import fit_screw
from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE, screw_motion
from articulate_ssl.geometry.se3 import se3, transform_points

AXIS = normalize(torch.tensor([0.3, 1.0, -0.2]), dim=0)
PIVOT = torch.tensor([0.2, -0.1, 0.3])
STATE = torch.linspace(-0.8, 0.8, 41)


def _poses(joint_type: int) -> torch.Tensor:
    """Relative poses [41, 4, 4] at the states, behind some mean pose."""
    mean = se3(roma.rotvec_to_rotmat(torch.tensor([0.5, -0.4, 0.8])), torch.tensor([0.1, 0.2, 0.0]))
    return screw_motion(AXIS, PIVOT, STATE * (0.3 if joint_type == PRISMATIC else 1.0), joint_type) @ mean


def _from_line(point: torch.Tensor, axis: torch.Tensor) -> float:
    return torch.linalg.cross(point - PIVOT, axis).norm().item()


@pytest.mark.parametrize("joint_type", [REVOLUTE, PRISMATIC], ids=["revolute", "prismatic"])
def test_axis_pivot_and_states_are_recovered_although_a_fifth_of_the_poses_are_wrong(joint_type):
    generator = torch.Generator().manual_seed(0)
    points = 0.3 * torch.randn(64, 3, generator=generator)
    poses = _poses(joint_type)
    right = torch.arange(41) % 5 != 2
    axis = normalize(torch.randn(41, 3, generator=generator), dim=-1)
    wrong = se3(roma.rotvec_to_rotmat(math.pi * axis), 0.3 * torch.randn(41, 3, generator=generator))
    poses = torch.where(right[:, None, None], poses, wrong @ poses)
    fit = fit_screw(poses, points, joint_type)
    sign = torch.sign(fit.axis @ AXIS)
    assert math.degrees(math.acos(min(1.0, (sign * fit.axis @ AXIS).item()))) < 1.5
    expected = STATE[right] * (0.3 if joint_type == PRISMATIC else 1.0)
    difference = sign * fit.state[right] - expected
    assert difference.std() < 0.02
    if joint_type == REVOLUTE:
        assert _from_line(fit.pivot, AXIS) < 0.03
    else:
        assert fit.pivot.tolist() == [0, 0, 0]
    assert fit.gap[right].max() < 0.02 < 0.1 < fit.gap[~right].median()
    assert fit.state.median().abs() < 1e-6
    rebuilt = screw_motion(fit.axis, fit.pivot, fit.state[right], joint_type) @ fit.mean
    torch.testing.assert_close(
        transform_points(rebuilt, points), transform_points(poses[right], points), rtol=0, atol=0.04
    )


def test_how_a_rod_is_turned_about_its_length_does_not_matter():
    generator = torch.Generator().manual_seed(1)
    rod = torch.randn(64, 3, generator=generator) * torch.tensor([0.3, 0.001, 0.001])
    roll = math.pi * torch.rand(41, generator=generator)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    poses = _poses(REVOLUTE) @ se3(roma.rotvec_to_rotmat(roll), torch.zeros(41, 3))
    fit = fit_screw(poses, rod, REVOLUTE)
    assert (fit.axis @ AXIS).abs() > math.cos(math.radians(1))
    assert _from_line(fit.pivot, AXIS) < 0.01
    assert fit.gap.max() < 0.005


def test_what_is_no_joint_leaves_a_gap():
    generator = torch.Generator().manual_seed(2)
    points = 0.3 * torch.randn(64, 3, generator=generator)
    rotation = roma.unitquat_to_rotmat(normalize(torch.randn(41, 4, generator=generator), dim=-1))
    free = se3(rotation, 0.3 * torch.randn(41, 3, generator=generator))
    assert fit_screw(free, points, REVOLUTE).gap.median() > 0.1
