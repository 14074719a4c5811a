"""Views of chests are turned square to their Manhattan frames, whatever axes canonical space has."""

from dataclasses import replace

import pytest
import roma
import torch
from articulated_objects import CHEST, Clouds, clouds, true_shape
from true_category import Category

from articulate_ssl.geometry.se3 import se3
from articulate_ssl.inference.common_shape import CommonShape
from articulate_ssl.inference.final_fit import FinalFit
from articulate_ssl.inference.hypothesis_registration import HypothesisRegistration
from articulate_ssl.inference.object_frame import ObjectFrame
from articulate_ssl.inference.options import InferenceOptions
from articulate_ssl.inference.part_frames import PartFrames
from articulate_ssl.inference.state_range import StateRange
from articulate_ssl.inference.view_search import ViewSearch
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.observation import Observation

# Of canonical space, in which no axis of the object is one of coordinates.
CANONICAL = roma.rotvec_to_rotmat(torch.tensor([0.4, -0.7, 0.3]))


def _off(count: int, degrees: float, seed: int = 0) -> torch.Tensor:
    """Rotations by so many degrees."""
    axis = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed))
    return roma.rotvec_to_rotmat(torch.nn.functional.normalize(axis, dim=-1) * torch.tensor(degrees).deg2rad())


def _degrees(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    return roma.rotmat_geodesic_distance(one, other).rad2deg()


def _chests(count: int, seed: int) -> tuple[Clouds, torch.Tensor]:
    """Clouds, and rotations canonical object space -> cloud."""
    data = clouds(CHEST, count=count, points=2048, resample=True, seed=seed)
    return data, data.base[:, :3, :3] @ CANONICAL.mT


@pytest.fixture(scope="module")
def learnt() -> ObjectFrame:
    frame = ObjectFrame()
    data, turn = _chests(16, seed=0)
    share = frame.learn(_off(16, 12.0) @ turn, data.points, CANONICAL @ _off(1, 20.0)[0])
    assert frame.learnt and float(share) == 1
    return frame


def test_the_frame_is_learnt_from_predictions_that_are_off(learnt):
    assert float(learnt.axes.det()) > 0
    along = (learnt.axes.mT @ CANONICAL).abs()
    assert along.amax(dim=0).min() > 0.995


class _Looks(torch.nn.Module):
    """In place of a network: what is turned as `truth` looks right, by so much."""

    def __init__(self, truth: torch.Tensor, odds: float) -> None:
        super().__init__()
        self.truth, self.odds, self.temperature = truth, odds, torch.tensor(1.0)

    def looks_right(self, frames: torch.Tensor, dense: torch.Tensor) -> torch.Tensor:
        truth = self.truth[:, None].expand_as(frames)
        return self.odds * (roma.rotmat_geodesic_distance(frames, truth) < 0.4).to(frames)


def test_a_network_that_is_sure_turns_views_to_another_side(learnt):
    data, turn = _chests(5, seed=5)
    quarter = roma.rotvec_to_rotmat(torch.tensor([0.0, 0.0, torch.pi / 2]))
    held = turn @ learnt.axes @ quarter @ learnt.axes.mT @ _off(1, 8.0)[0]
    points = data.points.clone()
    points[4] = 0.2 * torch.randn(points[4].shape, generator=torch.Generator().manual_seed(0))  # has no frame
    frame = ObjectFrame()
    frame.load_state_dict(learnt.state_dict())
    nearest, has = frame.square(points, held)
    assert nearest.shape == (5, 24, 3, 3) and has.tolist() == [True] * 4 + [False]
    assert _degrees(nearest[:4, 0], held[:4]).max() < 20
    frame.surface = _Looks(turn @ learnt.axes, odds=5.0)
    found, margin, other = frame.looked_at(points, held)
    assert other.tolist() == [True] * 4 + [False]
    assert _degrees(found[:4], turn[:4]).max() < 20
    assert margin[:4].min() > 0.9 and margin[4] == 0
    frame.surface.odds = 1.0  # not sure enough: what was held to be likely stays, and nothing is sure
    found, margin, other = frame.looked_at(points, held)
    assert not other.any() and not margin.any()
    torch.testing.assert_close(found[:4], nearest[:4, 0])
    frame.surface.odds, frame.surface.truth = 5.0, held @ learnt.axes
    found, margin, other = frame.looked_at(points, held)
    assert not other.any() and margin[:4].min() > 0.9
    frame.forget()
    assert frame.surface is None


def test_what_has_no_frame_teaches_none():
    ball = torch.nn.functional.normalize(torch.randn(8, 2048, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    turn, frame = _off(8, 70.0, seed=1), ObjectFrame()
    frame.learn(turn, ball, torch.eye(3))
    assert not frame.learnt


def _category(data: Clouds) -> ArticulatedShape:
    """In canonical object space, part by part."""
    shape = true_shape(CHEST, data)
    joints = replace(shape.joints, axis=shape.joints.axis @ CANONICAL.mT, pivot=shape.joints.pivot @ CANONICAL.mT)
    points = torch.cat([shape.part(part)[:600] for part in range(3)]) @ CANONICAL.mT
    return ArticulatedShape(points, torch.arange(3).repeat_interleave(600), joints)


@pytest.fixture(scope="module")
def final(learnt) -> FinalFit:
    data, _ = _chests(2, seed=0)
    options = InferenceOptions(refine=True, proportions=6)
    registration = HypothesisRegistration(options, Observation(unidirectional=True), StateRange(2))
    network = Category(_category(data))
    return FinalFit(network, registration, PartFrames(3), CommonShape(3), ViewSearch(3), learnt, options.proportions)


def test_explanations_are_turned_as_views_say_and_take_their_proportions(final):
    data, turn = _chests(6, seed=3)
    before = _off(6, 10.0, seed=2) @ turn
    middle = final.articulated.shape.points.mean(dim=0)
    place = data.base[:, :3, 3] + ((turn - before) @ middle)
    one = final.articulated.category_at(se3(before, place)[:, None], data.state[:, None] + 0.05)
    found = final.in_proportion(one, data.points[:, :512], data.points)
    # The mean of what the predictions that taught it were off by nothing can tell; all are turned alike but for that.
    off = found.base[:, 0, :3, :3].mT @ turn
    assert _degrees(off, off[:1].expand_as(off)).max() < 0.5 and _degrees(found.base[:, 0, :3, :3], turn).max() < 5
    line = (found.base[:, 0, None, :3, :3] @ found.axis[:, 0, ..., None]).squeeze(-1)
    truth = (data.base[:, None, :3, :3] @ data.axis[..., None]).squeeze(-1)
    assert (line * truth).sum(dim=-1).min() > 0.999
    assert (final.distance(found, data.points) < final.distance(one, data.points)).all()
    assert (found.state[:, 0] - data.state).abs().mean() < 0.03


def test_without_a_frame_and_without_dense_points_explanations_stay(final):
    data, turn = _chests(2, seed=4)
    before = se3(_off(2, 10.0) @ turn, data.base[:, :3, 3])
    one = final.articulated.category_at(before[:, None], data.state[:, None])
    assert final.in_proportion(one, data.points[:, :512], None) is one
    few = data.points[:, :40]  # of which no frame is made
    torch.testing.assert_close(final.object_frame.settled(one, few)[0].base, one.base)
    assert not final.object_frame.settled(one, few)[1].any()


def test_weights_from_before_there_was_a_frame_have_none(learnt):
    frame = ObjectFrame()
    frame.load_state_dict(learnt.state_dict())
    assert frame.learnt
    fresh = ObjectFrame()
    fresh.load_state_dict({})
    assert not fresh.learnt
    frame.forget()
    assert not frame.learnt
