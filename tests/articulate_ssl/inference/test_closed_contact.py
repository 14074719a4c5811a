"""A hinge is where its closed door lies on its body."""

import math
from dataclasses import replace

import pytest
import roma
import torch
from synthetic_predictions import chain_of_boxes, laptop

from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.geometry.se3 import se3, transform_points
from articulate_ssl.inference.articulation import part_motion
from articulate_ssl.inference.closed_contact import ClosedPlates, Contact, resting_on_bodies
from articulate_ssl.inference.prediction import concatenate

CLOSED = torch.tensor(0.3)  # states count from somewhere
THICK = 0.04
HINGE = (0.0, -0.25, -0.25)  # in the edge between body and door


def oven(opened: float, frame: float | None = None):
    """A body, a door before it, hinged below, and their cloud; of the body's front only a frame is there, if said."""
    boxes = [((0.6, 0.5, 0.6), (0, 0, 0)), ((0.56, THICK, 0.5), (0, -0.25 - THICK / 2, 0.0))]
    joint = (REVOLUTE, 0, 1, (1.0, 0, 0), HINGE)
    found, points = chain_of_boxes(boxes, [joint], [math.radians(opened)], num_points=4096)
    if frame is not None:
        inside = points @ found.base_pose[0, :3, :3] - found.base_pose[0, :3, 3] @ found.base_pose[0, :3, :3]
        hole = (inside[:, 1] < -0.249) & (inside[:, 0].abs() < 0.3 - frame) & (inside[:, 2].abs() < 0.3 - frame)
        kept = ~(hole & (found.part_id[0] == 0))
        points = points[kept]
        found = replace(found, part_id=found.part_id[:, kept], part_probability=found.part_probability[:, kept])
    found = replace(found, dense_part_id=found.part_id, joint_state=found.joint_state + CLOSED)
    # In canonical space parts are as they are at state 0.
    return resting(found), points[None]


def resting(found):
    """The same, whose canonical shape is that of its states."""
    back = part_motion(replace(found, canonical_pivot=found.canonical_pivot), -CLOSED.expand(1, 1))
    return replace(found, assembly=transform_points(back, found.assembly[:, :, None])[:, :, 0])


def moved(found, along: float, across: float = 0.0):
    """The same with its hinge elsewhere: along the door, away from the hinge, and across it, towards the body."""
    closed = torch.tensor([[0.0, across, along]])
    opened = roma.rotvec_to_rotmat((found.joint_state - CLOSED)[0] * torch.tensor([1.0, 0, 0]))
    return replace(found, joint_pivot=found.joint_pivot + closed @ (found.base_pose[0, :3, :3] @ opened).mT)


def in_type(found, dtype):
    return replace(found, **{name: v.to(dtype) for name, v in vars(found).items() if v.is_floating_point()})


def apart(found, truth) -> float:
    """How far a hinge is from another."""
    way = (found.joint_pivot - truth.joint_pivot)[0, 0]
    axis = truth.joint_axis[0, 0]
    return float((way - way @ axis * axis).norm())


@pytest.mark.parametrize("frame", [None, 0.08])
@pytest.mark.parametrize("along", [-0.05, 0.05])
@pytest.mark.parametrize("opened", [40, 90, 130])
def test_a_hinge_that_is_off_along_the_door_is_moved_back(opened, along, frame):
    truth, dense = oven(opened, frame)
    wrong = moved(truth, along)
    assert apart(wrong, truth) == pytest.approx(0.05, abs=1e-5)
    assert apart(resting_on_bodies(wrong, dense, CLOSED), truth) < 0.02


@pytest.mark.parametrize("opened", [0, 5, 40, 90, 130])
def test_a_hinge_that_is_right_stays(opened):
    truth, dense = oven(opened)
    assert apart(resting_on_bodies(truth, dense, CLOSED), truth) < 0.01


def test_a_closed_door_says_nothing_of_its_hinge():
    truth, dense = oven(0)
    wrong = moved(truth, 0.05)
    assert apart(resting_on_bodies(wrong, dense, CLOSED), truth) > 0.04


def test_gaps_are_seen_from_either_side():
    truth, dense = oven(90)
    gap = Contact.of(truth, dense, CLOSED).gap
    assert gap.abs() < 0.01
    # The door is open at right angles: what is moved along it is moved towards the body, or away from it.
    assert Contact.of(moved(truth, 0.03), dense, CLOSED).gap - gap == pytest.approx(0.03, abs=0.006)
    assert Contact.of(moved(truth, -0.03), dense, CLOSED).gap - gap == pytest.approx(-0.03, abs=0.006)


def test_slopes_are_by_how_much_gaps_change():
    truth, dense = oven(70)
    contact = Contact.of(truth, dense, CLOSED)
    for direction, slope in zip(contact.directions[0], contact.slope[0], strict=True):
        there = replace(truth, joint_pivot=truth.joint_pivot + 0.05 * direction)
        change = Contact.of(there, dense, CLOSED).gap - contact.gap
        assert -0.05 * slope == pytest.approx(float(change), abs=0.006)


def test_parts_stay_where_they_are():
    truth, dense = oven(80)
    found = resting_on_bodies(moved(truth, 0.05), dense, CLOSED)
    for same in ("part_pose", "joint_state", "joint_axis", "base_pose", "part_shape", "part_id"):
        assert torch.equal(getattr(found, same), getattr(truth, same))
    motion = part_motion(found, found.joint_state)
    center = transform_points(found.base_pose[:, None] @ motion, found.assembly[:, :, None])[:, :, 0]
    torch.testing.assert_close(center, found.part_pose[..., :3, 3])
    torch.testing.assert_close(transform_points(found.base_pose, found.canonical_pivot), found.joint_pivot)


def test_where_hardly_anything_is_seen_nothing_is_moved():
    truth, dense = oven(90)
    wrong = moved(truth, 0.05)
    few = torch.cat([(truth.part_id[0] == 0).nonzero()[:, 0], (truth.part_id[0] == 1).nonzero()[:20, 0]])
    wrong = replace(wrong, dense_part_id=wrong.dense_part_id[:, few])
    found = resting_on_bodies(wrong, dense[:, few], CLOSED)
    assert not Contact.of(wrong, dense[:, few], CLOSED).known.any()
    torch.testing.assert_close(found.joint_pivot, wrong.joint_pivot)


def test_a_door_that_closes_on_nothing_says_nothing():
    """Its hinge is so far before the body that no gap is as wide as is tried."""
    truth, dense = oven(90)
    wrong = moved(truth, 0.4)
    assert not Contact.of(wrong, dense, CLOSED).known.any()
    torch.testing.assert_close(resting_on_bodies(wrong, dense, CLOSED).joint_pivot, wrong.joint_pivot)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_it_turns_with_the_cloud(dtype):
    ovens = [oven(opened) for opened in (50, 100)]
    found, dense = [in_type(moved(one, 0.04), dtype) for one, _ in ovens], [points.to(dtype) for _, points in ovens]
    turn = se3(roma.random_rotmat(1).to(dtype)[0], torch.tensor([0.2, -0.1, 0.3], dtype=dtype))
    closed = CLOSED.to(dtype)
    for one, points in zip(found, dense, strict=True):
        there = replace(
            one,
            base_pose=turn @ one.base_pose,
            part_pose=turn @ one.part_pose,
            joint_axis=one.joint_axis @ turn[:3, :3].mT,
            joint_pivot=transform_points(turn, one.joint_pivot),
        )
        expected = transform_points(turn, resting_on_bodies(one, points, closed).joint_pivot)
        atol = 1e-5 if dtype == torch.float32 else 1e-8
        actual = resting_on_bodies(there, transform_points(turn, points), closed)
        torch.testing.assert_close(actual.joint_pivot, expected, atol=atol, rtol=0)


def test_a_cloud_does_not_depend_on_the_others():
    ovens = [oven(opened) for opened in (50, 100)]
    both = concatenate([moved(one, 0.04) for one, _ in ovens])
    found = resting_on_bodies(both, torch.cat([points for _, points in ovens]), CLOSED)
    for index, (one, points) in enumerate(ovens):
        alone = resting_on_bodies(moved(one, 0.04), points, CLOSED)
        torch.testing.assert_close(found.joint_pivot[index], alone.joint_pivot[0], atol=1e-6, rtol=0)


OFF = (0.02, -0.015)  # where hinges of laptops are predicted, across lids and along them
ABOUT_CLOSED = torch.tensor(math.radians(5))  # by which it is not known exactly when they are closed


def laptops(angles):
    """Laptops, their clouds, and predictions whose hinges are all off in the same way."""
    made = [laptop(math.radians(angle), points=4096, seed=seed) for seed, angle in enumerate(angles)]
    truth = concatenate([replace(found, dense_part_id=found.part_id) for found, _ in made])
    lid = truth.part_pose[:, 1, :3, :3]
    across, along = -lid[..., 2], -lid[..., 1]  # towards the base, when it is closed; away from the hinge
    wrong = replace(truth, joint_pivot=truth.joint_pivot + (OFF[0] * across + OFF[1] * along)[:, None])
    return truth, wrong, torch.stack([points for _, points in made])


def test_many_plates_say_together_where_their_hinges_are():
    _, wrong, dense = laptops(range(15, 100, 5))
    off = Contact.of(wrong, dense, ABOUT_CLOSED, plates=True).off()
    torch.testing.assert_close(off, -torch.tensor(OFF), atol=0.011, rtol=0)  # lids hang .005 above bases


def test_joint_states_alone_do_not_close_plates():
    truth, _, dense = laptops([40, 70])
    assert (Contact.of(truth, dense, ABOUT_CLOSED, plates=True).gap.abs() < 0.01).all()
    assert (Contact.of(truth, dense, ABOUT_CLOSED).gap.abs() > 0.02).any()


def test_plates_that_are_turned_over_say_little():
    """Some training clouds are explained wrongly."""
    _, wrong, dense = laptops(range(15, 100, 5))
    contact = Contact.of(wrong, dense, ABOUT_CLOSED, plates=True)
    gap = contact.gap.clone()
    gap[::5] = 0.1
    torch.testing.assert_close(contact._replace(gap=gap).off(), contact.off(), atol=0.006, rtol=0)


@pytest.mark.parametrize("angle", [20, 60, 95])
def test_a_plate_is_hinged_where_most_are_and_where_it_closes(angle):
    truth, wrong, dense = laptops([angle])
    off = -torch.tensor(OFF)
    found = resting_on_bodies(wrong, dense, ABOUT_CLOSED, off)
    assert off.norm() == pytest.approx(apart(wrong, truth), abs=1e-5)
    assert apart(found, truth) < 0.008
    unlike = resting_on_bodies(wrong, dense, ABOUT_CLOSED, torch.zeros(2))
    assert apart(found, truth) < apart(unlike, truth)


def test_boxes_close_as_their_faces_say_and_plates_as_training_showed():
    plates, rest = ClosedPlates(), torch.tensor(0.7)
    assert plates.closing(rest) == (rest, None)
    plates.learnt.fill_(True)
    assert plates.closing(rest)[0] is plates.closed and plates.closing(rest)[1] is plates.off
