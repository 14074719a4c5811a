"""Screw motions of revolute and prismatic joints."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rigid_motions import DTYPE, unit
from torch.testing import assert_close

from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE, axis_angle_to_rotation, screw_motion
from articulate_ssl.geometry.se3 import invert_se3, transform_points


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
