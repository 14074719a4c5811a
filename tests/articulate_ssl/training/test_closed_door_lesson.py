"""Doors of scans are closed, and views of them kept: in states that training does not show, and as cameras see them."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import roma
import torch
from boxes_with_doors import PIVOT, ZERO, box_shape

from articulate_ssl.discovery import reshaping
from articulate_ssl.discovery.from_scans import StandingScans
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.geometry.se3 import invert_se3, se3
from articulate_ssl.inference.part_frames import PartFrames
from articulate_ssl.inference.state_range import StateRange
from articulate_ssl.inference.view_search import ViewSearch
from articulate_ssl.ops.chamfer import nearest_distance
from articulate_ssl.training.closed_door_lesson import learn_closed_doors
from articulate_ssl.training.scan_space import ScanSpace

COUNT, POINTS = 6, 100
SEEN = (ZERO + 0.9, ZERO + 1.8)


def _scans() -> StandingScans:
    """Boxes with open doors, registered."""
    generator, shape = torch.Generator().manual_seed(0), box_shape()
    base = se3(roma.special_procrustes(torch.randn(COUNT, 3, 3, generator=generator)), torch.zeros(COUNT, 3))
    state = torch.linspace(*SEEN, COUNT)[:, None]
    clouds = shape.posed(base, state)
    found = RegisteredShape(shape, base, state, torch.zeros(COUNT, 2, 3), torch.zeros(COUNT))
    order = torch.randperm(clouds.shape[1], generator=generator)
    clouds, part = clouds[:, order], shape.label[order].expand(COUNT, -1)
    found = replace(found, point_part=part, quarters=torch.arange(COUNT) % 2)
    turns = roma.special_procrustes(torch.randn(COUNT, 9, 3, 3, generator=generator))
    return StandingScans(clouds, found, turns, 0.3)


@pytest.fixture
def module():
    """What the lesson needs of one; `asked` counts how often it wanted scans."""
    states, frames, shape = StateRange(1), PartFrames(2), box_shape()
    states.seen.copy_(torch.tensor([SEEN]))
    frames.flat.fill_(True)
    made = SimpleNamespace(states=states, part_frames=frames, num_points=POINTS, closed_views_samples=20, asked=0)

    def standing_scans(_data, num_points):
        made.asked += 1
        assert num_points == POINTS
        return _scans()

    made.recipe = SimpleNamespace(standing_scans=standing_scans)
    made.estimator = SimpleNamespace(closed_views=ViewSearch(2))
    category = SimpleNamespace(articulated_shape=lambda _: made.shape)
    made.shape, made.articulated = shape, SimpleNamespace(category=category, joint_type=REVOLUTE)
    return made


def _elsewhere(scans: StandingScans, frame: torch.Tensor) -> StandingScans:
    """The same, found in another canonical space, where states count from elsewhere and in the other sense."""
    found, middle = scans.found, ZERO + 0.3
    points = found.shape.posed(torch.eye(4)[None], torch.full((1, 1), middle))[0]
    shape = replace(found.shape, points=points, joints=replace(found.shape.joints, axis=-found.shape.joints.axis))
    base, turns = found.base @ invert_se3(frame), scans.turns @ frame[:3, :3].mT
    found = replace(found, shape=shape.in_frame(frame), base=base, state=middle - found.state)
    return replace(scans, found=found, turns=turns)


@pytest.mark.parametrize("elsewhere", [False, True])
def test_views_show_doors_from_closed_to_where_training_begins(module, monkeypatch, elsewhere):
    monkeypatch.setattr(reshaping, "_SPREAD", 0.0)  # of the very object, whose shape is known
    if elsewhere:
        turn = roma.random_rotmat(1, generator=torch.Generator().manual_seed(1))[0]
        scans = _elsewhere(_scans(), se3(turn, torch.zeros(3)))
        module.recipe.standing_scans = lambda *_: scans
    learn_closed_doors(module, None)
    views = module.estimator.closed_views
    assert 18 <= len(views.views) <= 24  # four of each scan, but for those that show too little
    assert views.state.min() > ZERO - 0.05 and views.state.max() < SEEN[0] + 0.05
    assert views.state.std() > 0.15
    assert module.states.rests and float(module.states.rest) == pytest.approx(ZERO, abs=0.03)
    assert set(views.quarters.tolist()) == {0, 1}
    assert 0.05 < (views.part == 1).double().mean() < 0.6
    scales = torch.linspace(0.5, 2.5, 101)  # by which views are normalised
    posed = module.shape.posed(torch.eye(4).repeat(len(views.views), 1, 1), views.state)
    for one, (cloud, whole) in enumerate(zip(views.views * views.step[:, None, None], posed, strict=True)):
        inside = (cloud - views.base[one, :3, 3]) @ views.base[one, :3, :3]
        off = nearest_distance(inside / scales[:, None, None], whole.expand(len(scales), -1, -1)).mean(dim=1)
        assert off.min() < 0.01
        away = nearest_distance((inside / scales[off.argmin()])[None], whole[module.shape.label == 1][None])[0]
        assert (away[views.part[one] == 1] < 0.03).all()


@pytest.mark.parametrize("seed", range(2))
def test_views_are_told_in_the_categorys_space(module, seed):
    turn = roma.random_rotmat(generator=torch.Generator().manual_seed(seed))
    frame = se3(turn, torch.tensor([0.1, -0.2, 0.05]))
    found = _elsewhere(_scans(), frame).found
    space = ScanSpace.of(module.shape, replace(found, shape=found.shape.scaled(3.0)), module.states.starts())
    torch.testing.assert_close(space.frame, frame, atol=0.004, rtol=0)
    states = torch.tensor([[ZERO], [ZERO + 0.3], [ZERO + 1.0]])
    torch.testing.assert_close(space.found_states(states), torch.tensor([[0.3], [0.0], [-0.7]]), atol=0.01, rtol=0)
    torch.testing.assert_close(space.states(space.found_states(states)), states)


def test_an_earlier_runs_views_are_forgotten(module):
    learn_closed_doors(module, None)
    module.part_frames.flat[1] = False
    learn_closed_doors(module, None)
    assert not module.estimator.closed_views.learnt and module.asked == 1


@pytest.mark.parametrize("least", [ZERO - 0.1, ZERO + 0.1])
def test_doors_that_training_shows_closed_need_no_views(module, least):
    module.states.seen.copy_(torch.tensor([[least, least + 1.0]]))
    learn_closed_doors(module, None)
    assert not module.estimator.closed_views.learnt and not module.asked
    assert not module.states.rests  # limits stay as they are


@pytest.mark.parametrize("what", ["axis", "pivot"])
def test_scans_whose_hinge_is_elsewhere_than_the_categorys_teach_nothing(module, caplog, what):
    joints = module.shape.joints
    other = {"axis": joints.axis.roll(1, dims=1), "pivot": (PIVOT + torch.tensor([0.5, 0.2, 0.0]))[None]}[what]
    scans = _scans()
    shape = replace(scans.found.shape, joints=replace(joints, **{what: other}))
    scans = replace(scans, found=replace(scans.found, shape=shape))
    module.recipe.standing_scans = lambda *_: scans
    learn_closed_doors(module, None)
    assert not module.estimator.closed_views.learnt and "found the hinge elsewhere" in caplog.text
    assert not module.states.rests
