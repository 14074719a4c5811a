"""Explanations take the proportions of their clouds: what that mends, and what it leaves alone."""

import math
from dataclasses import replace

import pytest
import roma
import torch
from articulated_objects import GLASSES, LAPTOP, OVEN, Clouds, clouds, true_shape
from tiny import POINTS, tiny_module

from articulate_ssl.discovery.registration import chamfer_l1, register_articulated
from articulate_ssl.geometry.orientation_range import OrientationRange
from articulate_ssl.geometry.se3 import invert_se3, se3, transform_points
from articulate_ssl.inference import final_fit, proportions
from articulate_ssl.inference.options import InferenceOptions
from articulate_ssl.inference.proportions import Descent, fit_proportions
from articulate_ssl.network.heads.shape import CanonicalShape
from articulate_ssl.network.heads.structure import Structure
from articulate_ssl.network.hypotheses import Hypotheses
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.observation import Observation

CYCLES = 25


def _observe(module, observation: Observation) -> None:
    """As if it had been trained so."""
    module.estimator.observation = module.estimator.registration.observation = observation


def _category(design, data: Clouds) -> ArticulatedShape:
    """The object of the clouds, part by part."""
    shape = true_shape(design, data)
    order = shape.label.argsort(stable=True)
    return replace(shape, points=shape.points[order], label=shape.label[order])


def _registered(shape: ArticulatedShape, data: Clouds) -> Hypotheses:
    """As registration of the category's shape leaves clouds, started at the truth."""
    base, state, _ = register_articulated(shape, data.points, data.base, data.state, (0.05, 0.02), 8)
    count, joints = len(base), shape.joints
    parts = torch.stack([shape.part(part) for part in range(shape.num_parts)])
    center = parts.mean(dim=1)
    pivot, axis = joints.pivot.expand(count, -1, -1), joints.axis.expand(count, 1, -1, -1)
    return Hypotheses(
        CanonicalShape(*(x.expand(count, *x.shape) for x in (parts - center[:, None], center))),
        Structure(torch.zeros(count, 1), pivot, axis, pivot, axis, joints.chain, joints.joint_type),
        base[:, None],
        state[:, None],
        torch.zeros(count, 0, shape.num_parts),
    )


def _error(one: Hypotheses, data: Clouds) -> torch.Tensor:
    return chamfer_l1(data.points, one.posed()[:, 0].flatten(1, 2))


@pytest.fixture(scope="module", params=[LAPTOP, OVEN, GLASSES], ids=["laptop", "oven", "glasses"])
def fitted(request):
    """Clouds of objects of other proportions, the explanations before, and after."""
    data = clouds(request.param, count=10, points=600, resample=True, proportions=0.25)
    shape = _category(request.param, data)
    before = _registered(shape, data)
    return data, before, fit_proportions(before, shape, data.points, Descent(CYCLES))


def test_states_orientations_and_hinges_come_nearer_to_the_truth(fitted):
    data, before, after = fitted
    off = [(one.state[:, 0] - data.state).abs().mean() for one in (before, after)]
    assert off[1] < 0.7 * off[0]
    turned = [roma.rotmat_geodesic_distance(one.base[:, 0, :3, :3], data.base[:, :3, :3]) for one in (before, after)]
    assert turned[1].mean() < turned[0].mean()
    assert _error(after, data).mean() < 0.9 * _error(before, data).mean()


def test_axes_stay_and_parts_stay_on_their_hinges(fitted):
    _, before, after = fitted
    assert torch.equal(after.axis, before.axis)
    # Wherever the door is, both parts move the hinge to the same place.
    pose, chain = after.object_pose()[:, 0], after.chain
    for joint, (parent, child) in enumerate(zip(chain.parent, chain.child, strict=True)):
        places = [transform_points(pose[:, part], after.pivot[:, joint, None]) for part in (parent, child)]
        torch.testing.assert_close(*places, atol=1e-5, rtol=0)


def test_a_cloud_that_is_turned_is_explained_alike_and_so_is_one_alone():
    data = clouds(OVEN, count=4, points=400, resample=True, proportions=0.2)
    shape = _category(OVEN, data)
    start = _registered(shape, data)
    every = fit_proportions(start, shape, data.points, Descent(CYCLES))
    alone = fit_proportions(start.rows(torch.tensor([2])), shape, data.points[2:3], Descent(CYCLES))
    torch.testing.assert_close(alone.state[0], every.state[2], atol=5e-3, rtol=0)
    torch.testing.assert_close(alone.base[0], every.base[2], atol=5e-3, rtol=0)
    turn = roma.rotvec_to_rotmat(torch.randn(4, 3, generator=torch.Generator().manual_seed(3)))
    pose = se3(turn, torch.zeros(4, 3))
    # What is rounded otherwise, steps of descent amplify, by processors in different ways: from few of them.
    few = 4
    every = fit_proportions(start, shape, data.points, Descent(few))
    assert (every.base - start.base).abs().amax() > 5e-3
    turned = fit_proportions(
        start.at(pose[:, None] @ start.base, start.state), shape, data.points @ turn.mT, Descent(few)
    )
    torch.testing.assert_close(turned.state, every.state, atol=2e-3, rtol=0)
    torch.testing.assert_close(turned.base, pose[:, None] @ every.base, atol=2e-3, rtol=0)


def test_it_runs_in_inference_mode():
    data = clouds(LAPTOP, count=2, points=200)
    shape = _category(LAPTOP, data)
    with torch.inference_mode():
        data = Clouds(*(x.clone() for x in data))
        after = fit_proportions(_registered(shape, data), shape, data.points, Descent(1))
    assert after.base.isfinite().all() and not after.base.requires_grad


@pytest.mark.parametrize("unidirectional", [False, True])
def test_registered_clouds_take_proportions_and_what_the_network_says_alone_does_not(unidirectional):
    module = tiny_module(inference=InferenceOptions(refine=True)).eval()
    points = torch.rand(3, POINTS, 3, generator=torch.Generator().manual_seed(6)) - 0.5
    _observe(module, Observation(unidirectional=unidirectional))
    own, alone = (module.estimator.predict(points, POINTS, refine=refine) for refine in (True, False))
    module.estimator.final.cycles = 0
    assert not torch.equal(module.estimator.predict(points, POINTS).part_shape, own.part_shape)
    assert torch.equal(module.estimator.predict(points, POINTS, refine=False).part_shape, alone.part_shape)


def test_what_a_view_hides_pulls_at_nothing():
    data = clouds(OVEN, count=6, points=600, resample=True, proportions=0.2)
    shape = _category(OVEN, data)
    start = _registered(shape, data)
    # Three quarters of every oven, without its back.
    own = torch.einsum("bij,bni->bnj", data.base[:, :3, :3], data.points - data.base[:, None, :3, 3])
    front = own[..., 0].argsort(dim=1, descending=True)[:, :450]
    seen = data.points.gather(1, front[..., None].expand(-1, -1, 3))
    one, both = (fit_proportions(start, shape, seen, Descent(CYCLES, way)) for way in (False, True))
    back = [some.object_shape()[:, 0, :, 0].amin(dim=1) for some in (one, both)]
    assert (back[1] > back[0]).all()  # where they pull, every body becomes shallower


@pytest.fixture
def two_hands(monkeypatch):
    """An estimator of a category of two hands, clouds, and the odds that were asked of them, one after another."""
    estimator = tiny_module(inference=InferenceOptions(refine=True), orientation_range=60.0).eval().estimator
    hands, odds = estimator.handedness, []
    hands.learnt.fill_(True)
    hands.slope.fill_(3.0)
    monkeypatch.setattr(hands, "likelier", lambda seen, _mirrored, own: odds.append(own) or seen)
    return estimator, torch.rand(3, POINTS, 3, generator=torch.Generator().manual_seed(6)) - 0.5, odds


def test_hands_are_told_by_the_errors_before_proportions(two_hands):
    estimator, points, odds = two_hands
    shown, _ = estimator.predict_with_rivals(points, POINTS)
    before, mirrored = estimator.mirror_errors(points, POINTS)
    torch.testing.assert_close(odds[0], estimator.handedness.log_odds(before, mirrored))
    assert (shown.reconstruction_error - before).abs().min() > 1e-4  # what is shown has proportions


def test_hands_of_boxes_that_may_be_closed_are_told_as_their_ways_are(two_hands, monkeypatch):
    """The explanation before would be one of an open door."""
    estimator, points, odds = two_hands
    own, mirrored = torch.tensor([0.1, 0.2, 0.3]), torch.tensor([0.3, 0.2, 0.1])
    both = torch.cat([own, mirrored])
    monkeypatch.setattr(type(estimator.other_views), "every_way", True)
    monkeypatch.setattr(estimator.other_views, "sought", lambda *of: (*of[:4], both))
    estimator.predict(points, POINTS, dense=points)
    estimator.search(points, dense=points)
    expected = estimator.handedness.log_odds(own, mirrored)
    assert len(odds) == 2 and all(torch.equal(some, expected) for some in odds)


def test_parts_are_drawn_to_a_hinge_that_floats(monkeypatch):
    """As discovery from views leaves it: off both plates; the way registration may move it costs nothing there."""
    data = clouds(LAPTOP, count=4, points=600, resample=True)
    shape = _category(LAPTOP, data)
    pivot = shape.joints.pivot + torch.tensor([0.0, 0.16, 0.08])
    shape = replace(shape, joints=replace(shape.joints, pivot=pivot))
    before = _registered(shape, data)

    def apart(one: Hypotheses) -> torch.Tensor:
        offset = one.object_shape() - one.pivot[:, :1, None]
        along = torch.linalg.cross(offset, one.axis[:, 0, 0, None, None].expand_as(offset)).norm(dim=-1)
        return along.sort(dim=-1).values[..., :8].mean(dim=-1).amax(dim=-1)

    left, drawn = (fit_proportions(before, shape, data.points, Descent(CYCLES, touching=way)) for way in (False, True))
    assert apart(left).max() > 0.08
    assert apart(drawn).max() < 0.055
    # Parts of complete clouds are not.
    seen = []
    monkeypatch.setattr(final_fit, "fit_proportions", lambda *args: seen.append(args[3][1:3]) or args[0])
    for views, unidirectional in ((60.0, False), (180.0, False), (60.0, True)):
        module = tiny_module(orientation_range=views).eval()
        _observe(module, Observation(OrientationRange(views), unidirectional))
        module.predict_points(torch.rand(1, POINTS, 3))
    assert seen == [(True, True), (True, False), (False, False)]


WIDE = torch.tensor([1.0, 1.0, 1.6])  # along the hinge
FACES = torch.eye(3).repeat(2, 1, 1)


@pytest.fixture(scope="module")
def wide_oven():
    """Clouds of ovens more than half as wide again as the category, and explanations that are turned right."""
    data = clouds(OVEN, count=4, points=600, resample=True)
    shape = _category(OVEN, data)
    own = transform_points(invert_se3(data.base), data.points)
    return data._replace(points=transform_points(data.base, own * WIDE)), shape, _registered(shape, data)


def test_what_is_much_wider_is_explained_as_wide_as_it_is(wide_oven):
    data, shape, start = wide_oven
    faces = fit_proportions(start, shape, data.points, Descent(CYCLES, faces=FACES))
    bodies = faces.object_shape()[:, 0]
    wide = (bodies.amax(dim=1) - bodies.amin(dim=1)) / (shape.part(0).amax(dim=0) - shape.part(0).amin(dim=0))
    torch.testing.assert_close(wide, WIDE.expand_as(wide), atol=0.08, rtol=0)
    assert (_error(faces, data) < 0.8 * _error(fit_proportions(start, shape, data.points, Descent(CYCLES)), data)).all()


def test_parts_start_as_wide_as_clouds_as_they_are_turned(wide_oven):
    """A door that hangs at right angles is deep where the body is high."""
    _, shape, _ = wide_oven
    stretch = torch.tensor([1.2, 0.9, 1.1])
    still, state = torch.eye(4).expand(1, 4, 4), torch.tensor([[math.pi / 2]])
    cloud = shape.posed(still, state) * stretch
    found = proportions._as_wide_as(cloud, shape, state, FACES).exp()[0]
    torch.testing.assert_close(found[0], stretch, atol=1e-4, rtol=0)
    turn = shape.joints.part_pose(still, state)[0, 1, :3, :3]
    torch.testing.assert_close(found[1], (turn.mT @ stretch).abs(), atol=1e-4, rtol=0)


def test_of_views_nothing_starts_as_wide_as_they_are(wide_oven, monkeypatch):
    data, shape, start = wide_oven
    monkeypatch.setattr(proportions, "_as_wide_as", lambda *_: pytest.fail("asked of a view"))
    fit_proportions(start, shape, data.points, Descent(1, bidirectional=False, faces=FACES))
