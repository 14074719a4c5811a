"""What is decided for gives way where its joints are as none was seen, and only there."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from articulated_objects import OVEN, clouds, true_shape
from tiny import POINTS, tiny_module
from true_category import final_fit

from articulate_ssl.geometry.screw import PRISMATIC
from articulate_ssl.inference.candidates import Candidates
from articulate_ssl.inference.final_fit import FinalFit
from articulate_ssl.inference.options import InferenceOptions
from articulate_ssl.inference.proportions import Descent, fit_proportions
from articulate_ssl.inference.state_range import StateRange
from articulate_ssl.network.hypotheses import Hypotheses


@pytest.fixture
def data():
    return clouds(OVEN, count=4, points=400, resample=True)


@pytest.fixture
def final(data) -> FinalFit:
    states = StateRange(1)
    states.limits.copy_(torch.tensor([[0.4, 1.6]]))
    return final_fit(true_shape(OVEN, data), states)


def _at(final: FinalFit, data, state: torch.Tensor) -> Hypotheses:
    return final.articulated.category_at(data.base[:, None], state[:, None])


def _limits(final: FinalFit, low: float, high: float) -> None:
    final.registration.states.seen.copy_(torch.tensor([[low, high]]))


def test_a_door_that_is_open_as_none_was_is_looked_for_again(final, data):
    _limits(final, 0.4, 1.6)
    # Of the first and the third cloud the door is sought below the oven, far from where it is.
    state = data.state.clone()
    state[::2] = 3.6
    start, rival = _at(final, data, state), _at(final, data, data.state)
    margin = torch.full((4,), 0.5)
    shown, other, new = final.within_limits(start, rival, margin, data.points, None)
    torch.testing.assert_close(shown.state[:, 0], data.state, atol=0.1, rtol=0)
    # The others are as they would be alone.
    alone = final.in_proportion(start, data.points, None)
    assert torch.equal(shown.state[1::2], alone.state[1::2]) and torch.equal(shown.base[1::2], alone.base[1::2])
    assert (new[1::2] == 0.5).all() and torch.equal(other.base[1::2], rival.base[1::2])


def test_a_rival_within_limits_takes_the_place_of_what_is_not(final, data, monkeypatch):
    _limits(final, 0.4, 1.6)
    start, rival = _at(final, data, data.state + 3.2), _at(final, data, data.state)
    # What was chosen stays stuck.
    monkeypatch.setattr(final.registration, "freed", lambda one, _points: one)
    monkeypatch.setattr(final, "_searched", lambda _points: start)
    shown, other, margin = final.within_limits(start, rival, torch.ones(4), data.points, None)
    torch.testing.assert_close(shown.state[:, 0], data.state, atol=0.1, rtol=0)
    assert torch.equal(other.state, start.state) and (margin == 0).all()
    # Unless it was known which way round the object is.
    monkeypatch.setattr(final, "view_search", SimpleNamespace(learnt=True))
    kept, other, margin = final.within_limits(start, rival, torch.ones(4), data.points, None)
    assert torch.equal(kept.state, final.in_proportion(start, data.points, None).state)
    assert other is rival and (margin == 1).all()


def test_what_nothing_within_limits_explains_stays(final, data):
    # Open ovens, where all that were seen were closed: others do not explain them.
    _limits(final, -0.3, 0.2)
    start = _at(final, data, data.state)
    shown, _, margin = final.within_limits(start, start, torch.ones(4), data.points, None)
    torch.testing.assert_close(shown.state[:, 0], data.state, atol=0.1, rtol=0)
    assert (margin == 1).all()


@pytest.mark.parametrize("known", [True, False])
def test_nothing_is_tried_again_in_vain(final, data, monkeypatch, known):
    if known:
        _limits(final, 0.4, 1.6)
    monkeypatch.setattr(final, "search", lambda _points: pytest.fail("searched"))
    state = data.state if known else data.state + 3.2
    start = _at(final, data, state)
    shown, rival, margin = final.within_limits(start, start, torch.ones(4), data.points, None)
    assert torch.equal(shown.state, final.in_proportion(start, data.points, None).state)
    assert rival is start and (margin == 1).all()


@pytest.mark.parametrize(("degrees", "again"), [(5.0, True), (0.5, False)])
def test_faces_are_asked_once_more_of_what_has_its_proportions(final, data, monkeypatch, degrees, again):
    """Of the third cloud they turn the door then; the others are as they would be alone."""
    start, said = _at(final, data, data.state), []
    known = torch.ones(4, dtype=torch.bool), torch.ones(4, 1, dtype=torch.bool)

    def settled(one, dense, afar=False):
        assert dense is data.points
        assert afar == bool(said)
        state = one.state.clone()
        if len(said):
            state[2] += math.radians(degrees)
        said.append(state)
        return one.at(one.base, state), known

    frames = SimpleNamespace(learnt=True, axes=torch.eye(3).repeat(2, 1, 1), settled=settled)
    monkeypatch.setattr(final, "part_frames", frames)
    points = data.points[:, :200]
    shown = final.in_proportion(start, points, data.points)
    assert len(said) == 2
    torch.testing.assert_close(shown.state, said[int(again)])
    category = final.articulated.category.articulated_shape(final.articulated.joint_type)
    once = fit_proportions(start, category, points, Descent(6, faces=frames.axes, known=known))
    changed = (shown.object_shape() != once.object_shape()).flatten(1).any(dim=1)
    assert changed.tolist() == [False, False, again, False]


@pytest.mark.parametrize(("first", "then", "kept"), [(40, -40, True), (0, 40, False), (0, 8, True)])
def test_faces_turn_a_door_far_only_if_that_explains_the_cloud_better(final, data, monkeypatch, first, then, kept):
    """Where the door was turned too far before, and where faces are of something else; a little as they say."""
    start, asked = _at(final, data, data.state), []
    known = torch.ones(4, dtype=torch.bool), torch.ones(4, 1, dtype=torch.bool)

    def settled(one, _dense, afar=False):
        asked.append(afar)
        return one.at(one.base, one.state + math.radians(then if afar else first)), known

    frames = SimpleNamespace(learnt=True, axes=torch.eye(3).repeat(2, 1, 1), settled=settled)
    monkeypatch.setattr(final, "part_frames", frames)
    shown = final.in_proportion(start, data.points[:, :200], data.points)
    assert asked == [False, True]
    torch.testing.assert_close(shown.state, start.state + math.radians(first + then * kept))


def test_what_slides_or_takes_no_proportions_stays_as_it_is(final, data):
    _limits(final, 0.4, 1.6)
    start = _at(final, data, data.state + 3.2)
    final.cycles = 0
    assert final.within_limits(start, start, torch.ones(4), data.points, None)[0] is start
    final.cycles, final.articulated.joint_type = 6, PRISMATIC
    assert final.within_limits(start, start, torch.ones(4), data.points, None)[0] is start


def test_objects_in_turned_frames_are_hinged_as_most_are_if_that_fits_better(monkeypatch):
    estimator = tiny_module(inference=InferenceOptions(refine=True)).eval().estimator
    points = torch.rand(4, POINTS, 3, generator=torch.Generator().manual_seed(0))
    predicted = estimator.predict(points, POINTS, dense=points)
    monkeypatch.setattr(estimator.registration, "freed", lambda one, _points: one)
    monkeypatch.setattr(estimator.final, "in_proportion", lambda one, *_: one)
    # Of what was not turned nothing is asked; of the others the one that fits worse gives way.
    error = torch.tensor([9.0, 9.0, 0.0, 9.0])
    turned = replace(predicted, reconstruction_error=error)
    quarters = torch.tensor([0, 1, 2, 3])
    shown = estimator._as_most_are(turned, quarters, points, points)
    kept = shown.reconstruction_error == error
    assert kept.tolist() == [True, False, True, False]
    assert torch.equal(shown.part_pose[kept], turned.part_pose[kept])
    torch.testing.assert_close(shown.base_pose, turned.base_pose, atol=1e-5, rtol=1e-5)
    # Nor what registration turns back, nor what is open as none is.
    back = turned.base_pose[:, :3, :3].mT

    def turned_back(one, _points):
        base = one.base.clone()
        base[:, 0, :3, :3] = base[:, 0, :3, :3] @ back[1] @ back[1]
        return one.at(base, one.state)

    monkeypatch.setattr(estimator.registration, "freed", turned_back)
    assert torch.equal(estimator._as_most_are(turned, quarters, points, points).reconstruction_error[2:3], error[2:3])
    monkeypatch.setattr(estimator.registration, "freed", lambda one, _points: one.at(one.base, one.state - 9))
    estimator.states.seen.copy_(torch.tensor([[5.0, 6.0]]))
    assert torch.equal(estimator._as_most_are(turned, quarters, points, points).reconstruction_error, error)


@pytest.mark.parametrize("known", [True, False])
def test_where_views_show_either_kind_turned_frames_stay(monkeypatch, known):
    estimator = tiny_module(inference=InferenceOptions(refine=True)).eval().estimator
    points = torch.rand(2, POINTS, 3, generator=torch.Generator().manual_seed(0))
    estimator.hinge_sides.learnt.fill_(True)
    estimator.hinge_sides.camera.learnt.fill_(True)
    monkeypatch.setattr(type(estimator.other_views), "lie", known)
    monkeypatch.setattr(estimator.other_views, "sought", lambda *of: (*of[:4], None))
    asked = []
    monkeypatch.setattr(estimator, "_as_most_are", lambda one, *_: (asked.append(one), one)[1])
    estimator.predict(points, POINTS, dense=points)
    assert len(asked) == (not known)


def test_candidates_well_beyond_joint_limits_must_fit_much_better_to_be_chosen():
    estimator = tiny_module().eval().estimator
    turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0]))
    base = torch.stack([torch.eye(4), turn]).expand(4, 2, 4, 4)
    error = torch.tensor([[0.10, 0.12], [0.10, 0.14], [0.10, 0.12], [0.10, 0.12]])
    # Well beyond the limits; the same, much better; about within; the other is beyond, too.
    state = torch.tensor([[[1.5], [0.5]], [[1.5], [0.5]], [[1.1], [0.5]], [[1.5], [-0.5]]])
    candidates = Candidates(error, base, state, lambda index: index)
    assert estimator._best(candidates)[0].tolist() == [0, 0, 0, 0]
    estimator.states.seen.copy_(torch.tensor([[0.0, 1.0]]))
    best, rival, margin = estimator._best(candidates)
    assert best.tolist() == [1, 0, 0, 0] and (best + rival == 1).all()
    torch.testing.assert_close(margin, 1 - torch.tensor([0.12 / 0.13, 0.13 / 0.14, 0.10 / 0.12, 0.10 / 0.12]))
