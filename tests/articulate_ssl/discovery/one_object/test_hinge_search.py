"""A hinge is found again, wherever it was thought to be, where bodies are placed."""

from dataclasses import replace

import pytest
import torch
from articulated_objects import DRAWER, OVEN, clouds

from articulate_ssl.discovery.one_object.adjustment import Placed
from articulate_ssl.discovery.one_object.find import _asked_again, refined
from articulate_ssl.discovery.one_object.hinge_search import has_one_hinge, turned_anew
from articulate_ssl.discovery.one_object.surface import Surface
from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.shape.joints import Joints


def _joints(data, design) -> Joints:
    return Joints(KinematicChain(2, 0, (0,), (1,)), data.axis.double(), data.pivot.double(), design[4])


@pytest.fixture(scope="module")
def world():
    data = clouds(OVEN, count=8, points=2048, resample=True, seed=1)
    truth = Placed(_joints(data, OVEN), data.base.double(), data.state.double())
    return truth, [Surface.of(cloud) for cloud in data.points.double().numpy()]


def _half_turned(truth: Placed) -> Placed:
    """Doors that turn by half of what they do, about a line on the far side of the body."""
    joints = replace(truth.joints, pivot=truth.joints.pivot + torch.tensor([[-0.4, 0.0, 0.3]]))
    return Placed(joints, truth.base, 0.5 * truth.state)


def _turned_away(truth: Placed) -> Placed:
    """Doors that turn the other way, about the same line, which no descent leads back from."""
    return replace(_half_turned(truth), state=-0.5 * truth.state)


def _hinges_apart(placed: Placed, truth: Placed) -> float:
    along = truth.joints.axis[0]
    between = placed.joints.pivot[0] - truth.joints.pivot[0]
    return float((between - (between @ along) * along).norm())


def _turned_otherwise(state: torch.Tensor, truth: Placed) -> float:
    """How far doors turn otherwise from cloud to cloud than they do, either way round; degrees."""
    one, other = (own[:, 0] - own[0, 0] for own in (state, truth.state))
    return float(torch.minimum((one - other).abs().max(), (one + other).abs().max()).rad2deg())


def test_hinge_and_states_are_found_again(world):
    truth, surfaces = world
    start = _half_turned(truth)
    assert _hinges_apart(start, truth) > 0.4
    assert _turned_otherwise(start.state, truth) > 20
    found = turned_anew(start, surfaces)
    assert _hinges_apart(found, truth) < 0.03  # two fine steps
    assert _turned_otherwise(found.state, truth) < 10  # two fine steps


def test_the_object_is_exact_with_it(world):
    truth, surfaces = world
    lost = refined(surfaces, _turned_away(truth), 64)
    found = _asked_again(lost, surfaces, 64)
    assert found.misfit.mean() < lost.misfit.mean()
    assert _turned_otherwise(lost.state, truth) > 2 * _turned_otherwise(found.state, truth)
    assert _turned_otherwise(found.state, truth) < 1


def test_what_fits_better_stays(world, monkeypatch):
    """A search that leads nowhere changes nothing."""
    truth, surfaces = world
    right = refined(surfaces, truth, 64)
    wrong = "articulate_ssl.discovery.one_object.find.turned_anew"
    monkeypatch.setattr(wrong, lambda placed, surfaces: _turned_away(placed))
    assert _asked_again(right, surfaces, 64) is right
    monkeypatch.setattr(wrong, lambda placed, surfaces: None)
    assert _asked_again(right, surfaces, 64) is right


def test_what_does_not_move_has_no_hinge(world):
    truth, surfaces = world
    still = Placed(truth.joints, truth.base[:1].expand(8, 4, 4), truth.state[:1].expand(8, 1))
    assert turned_anew(still, surfaces[:1] * 8) is None


def test_of_two_parts_one_of_which_turns(world):
    truth, _ = world
    assert has_one_hinge(truth.joints)
    drawer = clouds(DRAWER, count=1, points=8)
    assert not has_one_hinge(_joints(drawer, DRAWER))
