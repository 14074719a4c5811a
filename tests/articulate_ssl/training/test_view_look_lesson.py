"""Views of scans teach which way round boxes look: as they stand, whatever their doors do."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import roma
import torch
from boxes_with_doors import ZERO
from scanned_boxes import COUNT, SEEN, module_of_boxes

from articulate_ssl.discovery import reshaping
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.inference.box_turns import BoxTurns
from articulate_ssl.inference.upright_camera import UprightCamera
from articulate_ssl.inference.view_search import ViewSearch
from articulate_ssl.training import view_look_lesson
from articulate_ssl.training.view_look_lesson import learn_view_looks

FACES_CAMERA = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))  # the door, at -z, and what is on top, at +y, seen upright
AXES = torch.tensor([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]])  # columns: of the box
TURNS = 60


@pytest.fixture
def module(monkeypatch):
    """Seen by an upright camera, from within a right angle of the front; every third scan lies on its side."""
    monkeypatch.setattr(view_look_lesson, "VIEW_POINTS", 150)
    monkeypatch.setattr(reshaping, "_SPREAD", 0.0)
    made, camera = module_of_boxes(), UprightCamera()
    camera.learnt.fill_(True)
    camera.up.copy_(torch.tensor([0.0, 1.0, 0.0]))
    camera.vertical.copy_(torch.tensor([0.0, -1.0, 0.0]))
    camera.normal.copy_(torch.tensor([0.0, 0.0, 1.0]))
    yaw = torch.linspace(-1.4, 1.4, TURNS)[torch.randperm(TURNS, generator=torch.Generator().manual_seed(0))]
    turns = FACES_CAMERA @ roma.rotvec_to_rotmat(yaw[:, None] * torch.tensor([0.0, 1.0, 0.0]))
    lie = torch.arange(COUNT) % 3 == 0
    quarter = roma.rotvec_to_rotmat(torch.tensor([0.0, 0.0, math.pi / 2]))
    turns = turns @ torch.where(lie[:, None, None], quarter, torch.eye(3))[:, None]
    made.scans = replace(made.scans, turns=turns)
    made.part_frames.axes.copy_(AXES.expand(2, 3, 3))
    made.estimator.box_turns, made.estimator.view_search = BoxTurns(), ViewSearch(2)
    hinge_first = torch.eye(3)  # as `HingeSides.axes` are
    made.estimator.hinge_sides = SimpleNamespace(camera=camera, axes=hinge_first)
    made.estimator.other_views = SimpleNamespace(measure=lambda: made.states.set_rest(ZERO))
    made.estimator.closed_views.views = torch.zeros(1, 8, 3, dtype=torch.int8)  # there are some
    made.view_looks_samples, made.device = 300, torch.device("cpu")
    return made


def test_four_quarters_of_every_view_are_taught_and_the_first_stands(module, monkeypatch):
    asked = []
    monkeypatch.setattr(view_look_lesson, "learn_surface", lambda *of: asked.append(of))
    learn_view_looks(module, None)
    (((views, noisy), frames, order, least),) = asked
    count = len(views)
    assert 270 < count <= 306 and views.shape[1:] == (150, 3) and frames.shape == (count, 4, 3, 3) and least == 0.9
    assert torch.equal(order.sort().values, torch.arange(count))
    assert 0 < (noisy - views).norm(dim=-1).mean() < 0.02
    # Up is the same in all four, and each is a quarter farther about it.
    up = frames @ AXES[1]
    torch.testing.assert_close(up, torch.tensor([0.0, -1.0, 0.0]).expand_as(up), atol=0.01, rtol=0)
    relative = frames[:, :1].mT @ frames
    cosine = (relative.diagonal(dim1=-2, dim2=-1).sum(dim=-1) - 1) / 2
    torch.testing.assert_close(cosine, torch.tensor([1.0, 0.0, -1.0, 0.0]).expand(count, 4), atol=1e-5, rtol=0)
    # Doors are at the front.
    assert torch.equal(module.estimator.box_turns.axes, AXES)
    front = frames[:, 0] @ AXES.T @ torch.tensor([0.0, 0.0, -1.0])
    assert (front[:, 2] < 0.2).all()  # towards the camera, or nearly


def test_most_doors_are_nearly_closed(module, monkeypatch):
    monkeypatch.setattr(view_look_lesson, "learn_surface", lambda *of: None)
    states, views = [], view_look_lesson.ScanSpace.views

    def seen(space, *of):
        found = views(space, *of)
        states.append(found[1].state[:, 0])
        return found

    monkeypatch.setattr(view_look_lesson.ScanSpace, "views", seen)
    learn_view_looks(module, None)
    closed, opened = states
    assert closed.min() > ZERO - 0.05 and closed.max() < SEEN[0] + 0.05
    assert opened.min() > SEEN[0] - 0.05 and opened.max() < SEEN[1] + 0.05
    assert len(closed) / len(opened) == pytest.approx(2, abs=0.3)


def test_where_nothing_lies_simulated_views_say_which_way_is_up(module, monkeypatch):
    asked = []
    monkeypatch.setattr(view_look_lesson, "learn_surface", lambda *of: asked.append(of))
    module.estimator.hinge_sides.camera.forget()
    # Nobody has asked where objects are hinged, so what it has for axes is of no object.
    module.estimator.hinge_sides.axes = roma.rotvec_to_rotmat(torch.tensor([0.6, 0.2, 0.1]))
    turns = module.scans.turns[1]
    module.estimator.view_search.base = se3(turns, torch.zeros(len(turns), 3))
    learn_view_looks(module, None)
    camera = module.estimator.box_turns.camera
    assert camera.learnt
    for said, expected in ((camera.up, [0.0, 1.0, 0.0]), (camera.normal, [0.0, 0.0, 1.0])):
        torch.testing.assert_close(said.abs(), torch.tensor(expected), atol=0.01, rtol=0)
    up = asked[0][1] @ AXES[1]
    torch.testing.assert_close(up, torch.tensor([0.0, -1.0, 0.0]).expand_as(up), atol=0.01, rtol=0)
    module.estimator.hinge_sides.camera.learnt.fill_(True)
    learn_view_looks(module, None)
    assert not camera.learnt  # one of them is enough


def test_nothing_is_taught_where_up_or_closed_doors_are_not_known(module, monkeypatch):
    monkeypatch.setattr(view_look_lesson, "learn_surface", lambda *of: pytest.fail("taught"))
    module.estimator.hinge_sides.camera.forget()
    learn_view_looks(module, None)
    module.estimator.hinge_sides.camera.learnt.fill_(True)
    module.estimator.closed_views.forget()
    learn_view_looks(module, None)
    assert not module.asked and not module.estimator.box_turns.learnt


def test_few_views_teach_nothing(module, monkeypatch):
    monkeypatch.setattr(view_look_lesson, "learn_surface", lambda *of: pytest.fail("taught"))
    module.view_looks_samples = 100
    learn_view_looks(module, None)
    assert module.asked == 1 and not module.estimator.box_turns.learnt


def test_scans_of_few_points_teach_nothing(module, monkeypatch, caplog):
    monkeypatch.setattr(view_look_lesson, "VIEW_POINTS", 5000)
    learn_view_looks(module, None)
    assert not module.estimator.box_turns.learnt and "take denser ones" in caplog.text
