"""Of the 24 rotations in which a box is square to its cloud's axes, the one that looks right is the box's."""

import math

import pytest
import roma
import torch

from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.inference.box_turns import BoxTurns, Looks
from articulate_ssl.inference.surface_decision import SurfaceDecision

CLOUDS = 5


@pytest.fixture
def frames() -> torch.Tensor:
    torch.manual_seed(0)
    return roma.random_rotmat(CLOUDS)


class _Likes(SurfaceDecision):
    """To it looks right what it is told, by so much."""

    def __init__(self, right: torch.Tensor, by: float) -> None:
        super().__init__()
        self.chosen, self.by = right, by

    def looks_right(self, frames, dense):
        return torch.zeros(frames.shape[:2]).index_put((torch.arange(len(frames)), self.chosen), torch.tensor(self.by))


def test_the_object_is_turned_as_a_frame_says(frames):
    turns = BoxTurns()
    assert not turns.learnt
    turns.axes.copy_(roma.random_rotmat(1)[0])
    right = torch.tensor([0, 3, 7, 11, 23])
    turns.surface = _Likes(right, 6.0)
    assert turns.learnt
    rotation, likely, *_ = turns.looks(torch.zeros(CLOUDS, 8, 3), frames, torch.eye(3)[None])
    every = frames.mT[:, None] @ rotation_group(24).elements.float()
    torch.testing.assert_close(rotation @ turns.axes, every)
    assert torch.equal(likely.argmax(dim=1), right)
    torch.testing.assert_close(likely.exp().sum(dim=1), torch.ones(CLOUDS))


def test_looks_are_no_surer_than_the_network_is_right(frames):
    turns = BoxTurns()
    turns.surface = _Likes(torch.zeros(CLOUDS, dtype=torch.long), 6.0)
    turns.surface.temperature.fill_(3.0)
    likely = turns.looks(torch.zeros(CLOUDS, 8, 3), frames, torch.eye(3)[None]).likely
    torch.testing.assert_close(likely[:, 0] - likely[:, 1], torch.full((CLOUDS,), 6 / 3))


def test_what_lies_on_its_side_may_look_right_where_some_are_hinged_there(frames):
    """A box that looks right lies on its side as an explanation has it whose hinge is elsewhere."""
    every = frames.mT[:, None] @ rotation_group(24).elements.float()
    likely = torch.full((CLOUDS, 24), -9.0).index_fill(1, torch.tensor([4]), 1.0).index_fill(1, torch.tensor([9]), 0.0)
    quarter = roma.rotvec_to_rotmat(math.pi / 2 * torch.tensor([[0.0, 0, 0], [0, 0, 1]]))
    few, alike = torch.tensor([0.0, -2.0]), torch.zeros(CLOUDS, 24)
    looks = Looks(every, likely, quarter, few, alike)
    assert not looks.decided.any()
    tilt = roma.rotvec_to_rotmat(torch.tensor([0.2, 0.1, -0.1]))  # as registration leaves it
    said = torch.stack([every[:, 4], every[:, 9], every[:, 4] @ quarter[1], every[:, 9] @ quarter[1]], dim=1) @ tilt
    most, anyhow, counted, stood = looks.of(said)
    assert most.tolist() == [[0.0, -1.0, -10.0, -10.0]] * CLOUDS and anyhow.tolist() == [[0.0, -1.0] * 2] * CLOUDS
    assert counted.tolist() == [[0.0, -1.0, -2.0, -3.0]] * CLOUDS and stood.tolist() == [[4, 9, 4, 9]] * CLOUDS
    assert (looks.of(every)[1] > -10).sum(dim=1).tolist() == [4] * CLOUDS
    alone = Looks(every, likely, quarter[:1], few[:1], alike)
    assert torch.equal(torch.stack(alone.of(said)[:3]), most.expand(3, -1, -1))
    assert looks._replace(likely=likely.index_fill(1, torch.tensor([9]), -1.5)).decided.all()


def test_how_like_training_clouds_something_is_is_said_of_each_way_apart(frames):
    every = frames.mT[:, None] @ rotation_group(24).elements.float()
    alike = torch.full((CLOUDS, 24), -9.0).index_fill(1, torch.tensor([4]), -1.0).index_fill(1, torch.tensor([9]), -4.0)
    looks = Looks(every, torch.zeros(CLOUDS, 24), torch.eye(3)[None], torch.zeros(1), alike)
    tilt = roma.rotvec_to_rotmat(torch.tensor([0.2, 0.1, -0.1]))
    assert looks.like_others(every[:, [4, 9, 11]] @ tilt).tolist() == [[0.0, -3.0, -8.0]] * CLOUDS
    assert looks.rows(torch.tensor([1])).alike.shape == (1, 24)


def test_clouds_that_are_kept_say_how_boxes_are_turned_without_a_network(frames):
    generator = torch.Generator().manual_seed(0)
    shape = torch.rand(400, 3, generator=generator) - 0.5
    shape = shape[(shape.prod(dim=1) > 0) | (shape[:, 0] > 0.2)]  # no symmetry
    turns = BoxTurns()
    turns.axes.copy_(roma.random_rotmat(1)[0])
    turns.alike.learn(shape.expand(3, -1, -1), weight=60.0)
    assert turns.learnt
    right = torch.tensor([0, 3, 7, 11, 23])
    every = frames.mT[:, None] @ rotation_group(24).elements.float()
    rotation = every[torch.arange(CLOUDS), right]  # in which they stand -> camera
    looks = turns.looks(shape @ rotation.mT, frames)
    assert torch.equal(looks.alike.argmax(dim=1), right) and not looks.decided.any()
    torch.testing.assert_close(looks.likely, torch.full((CLOUDS, 24), -math.log(24)))
    turns.alike.forget()
    assert not turns.learnt and not turns.alike.likely(shape[None], every[:1]).any()


def test_weights_from_before_it_was_taught_have_none():
    taught, other = BoxTurns(), BoxTurns()
    taught.surface = SurfaceDecision()
    taught.axes.copy_(roma.random_rotmat(1)[0])
    other.load_state_dict(taught.state_dict())
    assert other.learnt and torch.equal(other.axes, taught.axes)
    taught.alike.learn(torch.rand(5, 80, 3), weight=30.0)
    other.load_state_dict(taught.state_dict())
    assert all(torch.equal(value, other.alike.state_dict()[name]) for name, value in taught.alike.state_dict().items())
    other.load_state_dict({})
    assert other.surface is None and torch.equal(other.axes, taught.axes)
