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
    few = torch.tensor([0.0, -2.0])
    looks = Looks(every, likely, quarter, few)
    assert not looks.decided.any()
    tilt = roma.rotvec_to_rotmat(torch.tensor([0.2, 0.1, -0.1]))  # as registration leaves it
    said = torch.stack([every[:, 4], every[:, 9], every[:, 4] @ quarter[1], every[:, 9] @ quarter[1]], dim=1) @ tilt
    most, anyhow, counted, stood = looks.of(said)
    assert most.tolist() == [[0.0, -1.0, -10.0, -10.0]] * CLOUDS and anyhow.tolist() == [[0.0, -1.0] * 2] * CLOUDS
    assert counted.tolist() == [[0.0, -1.0, -2.0, -3.0]] * CLOUDS and stood.tolist() == [[4, 9, 4, 9]] * CLOUDS
    assert (looks.of(every)[1] > -10).sum(dim=1).tolist() == [4] * CLOUDS
    alone = Looks(every, likely, quarter[:1], few[:1])
    assert torch.equal(torch.stack(alone.of(said)[:3]), most.expand(3, -1, -1))
    assert Looks(every, likely.index_fill(1, torch.tensor([9]), -1.5), quarter, few).decided.all()


def test_weights_from_before_it_was_taught_have_none():
    taught, other = BoxTurns(), BoxTurns()
    taught.surface = SurfaceDecision()
    taught.axes.copy_(roma.random_rotmat(1)[0])
    other.load_state_dict(taught.state_dict())
    assert other.learnt and torch.equal(other.axes, taught.axes)
    other.load_state_dict({})
    assert not other.learnt and torch.equal(other.axes, taught.axes)
