"""Of the 24 rotations in which a box is square to its cloud's axes, the one that looks right is the box's."""

import pytest
import roma
import torch

from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.inference.box_turns import BoxTurns
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
    rotation, likely = turns.looks(torch.zeros(CLOUDS, 8, 3), frames)
    every = frames.mT[:, None] @ rotation_group(24).elements.float()
    torch.testing.assert_close(rotation @ turns.axes, every)
    assert torch.equal(likely.argmax(dim=1), right)
    torch.testing.assert_close(likely.exp().sum(dim=1), torch.ones(CLOUDS))


def test_looks_are_no_surer_than_the_network_is_right(frames):
    turns = BoxTurns()
    turns.surface = _Likes(torch.zeros(CLOUDS, dtype=torch.long), 6.0)
    turns.surface.temperature.fill_(3.0)
    _, likely = turns.looks(torch.zeros(CLOUDS, 8, 3), frames)
    torch.testing.assert_close(likely[:, 0] - likely[:, 1], torch.full((CLOUDS,), 6 / 3))


def test_weights_from_before_it_was_taught_have_none():
    taught, other = BoxTurns(), BoxTurns()
    taught.surface = SurfaceDecision()
    taught.axes.copy_(roma.random_rotmat(1)[0])
    other.load_state_dict(taught.state_dict())
    assert other.learnt and torch.equal(other.axes, taught.axes)
    other.load_state_dict({})
    assert not other.learnt and torch.equal(other.axes, taught.axes)
