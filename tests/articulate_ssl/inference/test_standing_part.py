"""The base is the part that stands: found from how directions spread, and a tree hung from another part is the same."""

import math
from dataclasses import replace

import pytest
import roma
import synthetic_predictions as synthetic
import torch

from articulate_ssl.inference.articulation import articulate, posed_parts
from articulate_ssl.inference.prediction import concatenate
from articulate_ssl.inference.standing_part import StandingPart, rerooted, steadiness


def _views(count: int = 200, tilt: float = 0.15) -> torch.Tensor:  # [n, 2, 3, 3]
    """A base that turns about the vertical under cameras that look down differently, and a lid that is open between
    20 and 100 degrees."""
    generator = torch.Generator().manual_seed(0)
    yaw = 3 * torch.rand(count, generator=generator) - 1.5
    look = 0.5 + tilt * torch.randn(count, generator=generator)
    opened = (20 + 80 * torch.rand(count, generator=generator)).deg2rad()
    about = {axis: torch.eye(3)[k] for k, axis in enumerate("xyz")}
    base = roma.rotvec_to_rotmat(look[:, None] * about["x"]) @ roma.rotvec_to_rotmat(yaw[:, None] * about["z"])
    return torch.stack([base, base @ roma.rotvec_to_rotmat(opened[:, None] * about["x"])], dim=1)


def test_spread_is_that_of_the_steadiest_direction():
    still = torch.eye(3).expand(10, 1, 3, 3)
    about = roma.rotvec_to_rotmat(torch.linspace(-1, 1, 11)[:, None] * torch.tensor([0.0, 0.6, 0.8]))[:, None]
    assert steadiness(still) == pytest.approx(0, abs=1e-6) and steadiness(about) == pytest.approx(0, abs=1e-3)
    # Each direction of the axes keeps still for two of these, or for none.
    swung = roma.rotvec_to_rotmat(torch.tensor([[0.3, 0, 0], [-0.3, 0, 0], [0, 0.3, 0], [0, -0.3, 0]]))
    assert math.cos(steadiness(swung[:, None])) == pytest.approx((1 + math.cos(0.3)) / 2, abs=1e-6)


@pytest.mark.parametrize("base", [0, 1])
def test_the_part_that_stands_is_the_base_whichever_the_tree_has(base):
    standing = StandingPart()
    spread = standing.learn(_views(), base)
    assert standing.learnt and standing.root == 0 and spread[0] < 0.75 * spread[1]
    standing.learn(_views().flip(1), base)
    assert standing.root == 1


@pytest.mark.parametrize("base", [0, 1])
def test_a_door_that_is_as_steady_as_its_body_does_not_take_its_place(base):
    views = _views()
    opened = roma.rotvec_to_rotmat(torch.linspace(0, 1, len(views))[:, None] * torch.tensor([0.0, 0.0, 1.5]))
    standing = StandingPart()
    standing.learn(torch.stack([views[:, 0], views[:, 0] @ opened], dim=1), base)
    assert standing.learnt and standing.root == base


def test_a_handful_of_clouds_teaches_nothing():
    standing = StandingPart()
    standing.learn(_views(), 0)
    standing.learn(_views(20), 0)
    assert not standing.learnt
    prediction = synthetic.laptop()[0]
    assert standing.stood(prediction) is prediction


@pytest.mark.parametrize(
    ("make", "root"), [*((synthetic.drawer, root) for root in range(4)), *((synthetic.arm, root) for root in range(3))]
)
def test_hung_from_another_part_the_object_is_the_same_and_moves_the_same(make, root):
    prediction = make()[0]
    hung = rerooted(prediction, root)
    assert root not in hung.joint_child
    assert torch.equal(hung.part_pose, prediction.part_pose) and torch.equal(hung.joint_state, prediction.joint_state)
    torch.testing.assert_close(articulate(hung, hung.joint_state), posed_parts(prediction), atol=1e-5, rtol=1e-5)
    moved = prediction.joint_state + 0.3
    there, here = articulate(hung, moved)[0], articulate(prediction, moved)[0]
    # The base stays where it was, so only the parts' places among each other can be the same.
    a, b = there.flatten(0, 1).double(), here.flatten(0, 1).double()
    torch.testing.assert_close(torch.cdist(a, a), torch.cdist(b, b), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(there[root], posed_parts(prediction)[0, root], atol=1e-5, rtol=1e-5)


def test_there_and_back_is_the_prediction():
    prediction = synthetic.laptop()[0]
    back = rerooted(rerooted(prediction, 1), 0)
    for name in ("base_pose", "joint_axis", "canonical_axis", "joint_parent", "joint_child"):
        torch.testing.assert_close(getattr(back, name), getattr(prediction, name))


def test_different_trees_are_refused():
    prediction = synthetic.laptop()[0]
    other = replace(prediction, joint_parent=prediction.joint_child, joint_child=prediction.joint_parent)
    with pytest.raises(ValueError, match="different trees"):
        rerooted(concatenate([prediction, other]), 1)
    with pytest.raises(ValueError, match="part 2 cannot be the base of 2 parts"):
        rerooted(prediction, 2)
