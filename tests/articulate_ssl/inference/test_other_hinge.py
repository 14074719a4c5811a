"""An oven hinged at its side is the category's oven, whose hinge was turned there."""

import math

import pytest
import roma
import torch
from articulated_objects import OVEN, clouds, true_shape
from boxes_with_doors import TopIsUp, box_sides, lying_boxes
from true_category import final_fit

from articulate_ssl.geometry.se3 import se3
from articulate_ssl.inference.other_hinge import OtherHinge
from articulate_ssl.inference.part_frames import PartFrames
from articulate_ssl.inference.state_range import StateRange

# Columns: the hinge, what is square to it and to the closed door's normal, which points at the body.
AXES = torch.tensor([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]])
# Where a quarter, a half and three quarters take the hinge below: in the corners of the door, (.5, 0 to .6, .05 to .4).
LINES = {
    1: ((0.0, 0, -1), (0.5, 0.0, 0.225)),
    2: ((0.0, -1, 0), (0.5, 0.3, 0.4)),
    3: ((0.0, 0, 1), (0.5, 0.6, 0.225)),
}
CLOSED = torch.zeros(1)


@pytest.fixture
def shape():
    return true_shape(OVEN, clouds(OVEN, points=4000))


def _turned(shape, quarters: int, closed=CLOSED) -> OtherHinge:
    turn = roma.rotvec_to_rotmat(quarters * math.pi / 2 * AXES[:, 2])
    return OtherHinge.of(shape, turn, AXES, closed)


def _posed(shape, state: float):
    return shape.posed(torch.eye(4)[None], torch.tensor([[state]]))[0]


@pytest.mark.parametrize("quarters", LINES)
def test_the_same_door_opens_elsewhere(shape, quarters):
    other = _turned(shape, quarters).shape(shape)
    axis, pivot = (torch.tensor([value]) for value in LINES[quarters])
    torch.testing.assert_close(other.joints.axis, axis, atol=1e-6, rtol=0)
    torch.testing.assert_close(other.joints.pivot, pivot, atol=0.01, rtol=0)
    torch.testing.assert_close(_posed(other, 0.0), _posed(shape, 0.0), atol=1e-6, rtol=0)
    door = _posed(other, 1.0)[other.label == 1]
    away = (door - pivot) @ torch.linalg.cross(axis[0], torch.tensor([1.0, 0, 0]))
    assert door[:, 0].max() > 0.7 and (away.abs() < 0.6).all()  # outwards, as wide as it is
    torch.testing.assert_close(_posed(other, 1.0)[other.label == 0], shape.part(0))


def test_states_count_from_where_they_did(shape):
    """A door that is closed at another joint state is closed there."""
    other = _turned(shape, 1, torch.tensor([0.5])).shape(shape)
    torch.testing.assert_close(_posed(other, 0.5), _posed(shape, 0.5), atol=1e-6, rtol=0)
    assert (_posed(other, 1.5) - _posed(shape, 1.5)).norm(dim=1).max() > 0.3


def test_turned_by_nothing_it_stays(shape):
    other = _turned(shape, 0)
    torch.testing.assert_close(other.shape(shape).points, shape.points, atol=1e-6, rtol=0)
    torch.testing.assert_close(other.pivot[:, [0, 2]], shape.joints.pivot[:, [0, 2]], atol=0.01, rtol=0)


def test_faces_lie_as_the_door_does(shape):
    closed = torch.tensor([0.5])
    frames, other = PartFrames(2), _turned(shape, 3, closed)
    frames.direction.copy_(shape.joints.axis)
    frames.axes[1] = roma.rotvec_to_rotmat(torch.tensor([0.1, 0.2, 0.3]))
    moved = other.frames(frames, shape.joints)
    still, at = torch.eye(4)[None], closed[None]
    was = shape.joints.part_pose(still, at)[0, 1, :3, :3] @ frames.axes[1]
    now = other.shape(shape).joints.part_pose(still, at)[0, 1, :3, :3] @ moved.axes[1]
    torch.testing.assert_close(now, was, atol=1e-6, rtol=0)
    torch.testing.assert_close(moved.direction, other.axis, atol=1e-6, rtol=0)
    assert torch.equal(moved.axes[0], frames.axes[0])
    assert not torch.equal(frames.axes[1], moved.axes[1])  # those of the category stay


def test_explanations_are_posed_as_the_shape_is(shape):
    final = final_fit(shape, StateRange(1))
    final.registration.states.set_rest(0.0)
    other = final.hinge(_turned(shape, 1).turn, AXES)
    base = se3(roma.rotvec_to_rotmat(torch.tensor([[0.4, -0.2, 0.9]])), torch.tensor([[0.1, 0.2, 0.3]]))
    state = torch.tensor([[0.7]])
    one = final.hinged_at(final.articulated.category_at(base[:, None], state[:, None]), other)
    category = final.articulated.shape
    posed = other.shape(category).posed(base, state)
    torch.testing.assert_close(one.posed()[0, 0].flatten(0, 1), posed[0], atol=1e-5, rtol=0)


def test_who_stands_and_is_hinged_elsewhere_is_as_rare_as_who_lies():
    prediction, dense, true = lying_boxes([0, 1, 2, 3])
    sides = box_sides()
    sides.surface = TopIsUp()
    prediction = sides.counted_from_closed(prediction)
    standing, quarters = sides.decided(prediction, dense)
    assert not sides.hinged(prediction.canonical_axis[:, 0]).any()
    hinged = sides.hinged(standing.canonical_axis[:, 0])
    assert torch.equal(hinged, quarters) and sorted(hinged.tolist()) == [0, 1, 2, 3]
    axis = (true @ sides.hinges[hinged] @ sides.axes[:, 0, None])[..., 0]
    torch.testing.assert_close(axis, prediction.joint_axis[:, 0], atol=0.03, rtol=0)
    assert not sides.decided(standing, dense)[1].any()
    # Where it is never so, it lies.
    sides.log_prior.copy_(torch.tensor([0.0, -1e3, -1e3, -1e3]))
    lying, _ = sides.decided(standing, dense)
    torch.testing.assert_close(lying.base_pose[:, :3, :3], prediction.base_pose[:, :3, :3], atol=0.03, rtol=0)
    # Doors are upside down, or not.
    sides.doors.fill_(True)
    assert len(sides.hinges) == 2 and sides.hinged(standing.canonical_axis[:, 0])[hinged == 2].tolist() == [1]
