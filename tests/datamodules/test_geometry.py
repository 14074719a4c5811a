"""SE(3), screw motions and forward kinematics."""

from __future__ import annotations

import math

import pytest
import roma
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from datamodules.geometry import (
    PRISMATIC,
    REVOLUTE,
    axis_angle_to_rotation,
    forward_kinematics,
    invert_se3,
    screw_motion,
    se3,
    transform_points,
)

DTYPE = torch.float64


def random_pose(*batch: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    quaternion = torch.randn(*batch, 4, dtype=DTYPE, generator=generator)
    rotation = roma.unitquat_to_rotmat(torch.nn.functional.normalize(quaternion, dim=-1))
    return se3(rotation, torch.randn(*batch, 3, dtype=DTYPE, generator=generator))


def unit(*values: float) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.tensor(values, dtype=DTYPE), dim=-1)


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


def test_positive_rotation_is_counter_clockwise_seen_from_the_tip():
    motion = screw_motion(
        unit(0, 0, 1), torch.tensor([1.0, 0.0, 0.0], dtype=DTYPE), torch.tensor(math.pi / 2).to(DTYPE), REVOLUTE
    )
    moved = transform_points(motion, torch.tensor([[2.0, 0.0, 5.0]], dtype=DTYPE))
    assert_close(moved, torch.tensor([[1.0, 1.0, 5.0]], dtype=DTYPE))


@settings(max_examples=30, deadline=None)
@given(
    axis=st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda a: math.hypot(*a) > 0.1),
    pivot=st.tuples(*[st.floats(-5, 5)] * 3),
    first=st.floats(-7, 7),
    second=st.floats(-7, 7),
    along=st.floats(-3, 3),
)
def test_revolute_motions_compose_and_fix_their_line(axis, pivot, first, second, along):
    axis, pivot = unit(*axis), torch.tensor(pivot, dtype=DTYPE)

    def motion(state: float) -> torch.Tensor:
        return screw_motion(axis, pivot, torch.tensor(state, dtype=DTYPE), REVOLUTE)

    assert_close(motion(first) @ motion(second), motion(first + second), atol=1e-9, rtol=0)
    assert_close(invert_se3(motion(first)), motion(-first), atol=1e-9, rtol=0)
    on_line = (pivot + along * axis)[None]
    assert_close(transform_points(motion(first), on_line), on_line, atol=1e-9, rtol=0)


def test_rotation_agrees_with_the_matrix_exponential():
    axis, angle = unit(0.3, -0.5, 0.8), torch.tensor([0.0, 1e-9, 0.7, math.pi, 6.0], dtype=DTYPE)
    x, y, z = axis.tolist()
    skew = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=DTYPE)
    expected = torch.linalg.matrix_exp(angle[:, None, None] * skew)
    assert_close(axis_angle_to_rotation(axis, angle), expected, atol=1e-9, rtol=0)


def test_prismatic_motion_slides_along_the_axis_whatever_the_pivot():
    axis, pivot = unit(1, 2, 2), torch.randn(3, dtype=DTYPE)
    motion = screw_motion(axis, pivot, torch.tensor([0.0, 0.6], dtype=DTYPE), PRISMATIC)
    assert_close(motion[:, :3, :3], torch.eye(3, dtype=DTYPE).expand(2, 3, 3))
    assert_close(motion[:, :3, 3], torch.tensor([[0.0, 0.0, 0.0], [0.2, 0.4, 0.4]], dtype=DTYPE))


def test_unknown_joint_type_is_refused():
    with pytest.raises(ValueError, match="joint_type must be 0"):
        screw_motion(unit(1, 0, 0), torch.zeros(3), torch.zeros(()), 2)


def test_screw_motion_gradients_are_finite_and_right_at_zero_angle():
    axis, pivot = unit(1, 1, 0).float().requires_grad_(), torch.randn(3).requires_grad_()
    state = torch.zeros((), requires_grad=True)
    point = torch.tensor([[0.0, 0.0, 1.0]])
    moved = transform_points(screw_motion(axis, pivot, state, REVOLUTE), point)
    gradients = torch.autograd.grad(moved[0, 0], (axis, pivot, state))
    assert all(torch.isfinite(g).all() for g in gradients)
    # d/dq of a rotating point is axis x (point - pivot).
    assert_close(gradients[2], torch.linalg.cross(axis, point[0] - pivot)[0])


@pytest.mark.parametrize("joint_type", [REVOLUTE, PRISMATIC])
def test_gradcheck(joint_type):
    axis = unit(0.2, -0.4, 0.9).expand(2, 3).clone().requires_grad_()
    pivot = torch.randn(2, 3, dtype=DTYPE, requires_grad=True)
    state = torch.tensor([0.3, -1.2], dtype=DTYPE, requires_grad=True)
    assert torch.autograd.gradcheck(lambda a, p, q: screw_motion(a, p, q, joint_type), (axis, pivot, state))


def test_forward_kinematics_composes_from_the_root_outwards():
    # Tree 2 -> 0 -> 3 and 2 -> 1, joints listed child first.
    motion = random_pose(4, 3)
    pose = forward_kinematics(motion, parent=[0, 2, 2], child=[3, 0, 1], num_parts=4)
    assert_close(pose[:, 2], torch.eye(4, dtype=DTYPE).expand(4, 4, 4))
    assert_close(pose[:, 0], motion[:, 1])
    assert_close(pose[:, 1], motion[:, 2])
    assert_close(pose[:, 3], motion[:, 1] @ motion[:, 0])


def test_forward_kinematics_carries_a_distal_joint_line_with_its_parent():
    axis = torch.stack([unit(0, 0, 1), unit(0, 0, 1)])
    pivot = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], dtype=DTYPE)
    motion = screw_motion(axis, pivot, torch.full((2,), math.pi / 2, dtype=DTYPE), REVOLUTE)
    pose = forward_kinematics(motion, [0, 1], [1, 2], 3)
    elbow, hand = torch.tensor([[1.0, 0.0, 0.0]], dtype=DTYPE), torch.tensor([[2.0, 0.0, 0.0]], dtype=DTYPE)
    assert_close(transform_points(pose[2], elbow), torch.tensor([[0.0, 1.0, 0.0]], dtype=DTYPE))
    assert_close(transform_points(pose[2], hand), torch.tensor([[-1.0, 1.0, 0.0]], dtype=DTYPE))


def test_forward_kinematics_without_joints_leaves_parts_at_rest():
    pose = forward_kinematics(torch.empty(5, 0, 4, 4), [], [], 2)
    assert_close(pose, torch.eye(4).expand(5, 2, 4, 4))


def test_forward_kinematics_gradcheck():
    axis, pivot = unit(1, 0, 1).expand(2, 3), torch.randn(2, 3, dtype=DTYPE)

    def last_part(state: torch.Tensor) -> torch.Tensor:
        return forward_kinematics(screw_motion(axis, pivot, state, REVOLUTE), [0, 1], [1, 2], 3)[2]

    assert torch.autograd.gradcheck(last_part, torch.tensor([0.0, 0.4], dtype=DTYPE, requires_grad=True), atol=1e-4)


@pytest.mark.parametrize(
    ("parent", "child", "message"),
    [([0, 1], [2, 2], "two parents"), ([1, 0], [0, 1], "cycle"), ([0], [0], "cycle")],
)
def test_joints_that_form_no_tree_are_refused(parent, child, message):
    with pytest.raises(ValueError, match=message):
        forward_kinematics(torch.eye(4).expand(len(child), 4, 4), parent, child, 3)
