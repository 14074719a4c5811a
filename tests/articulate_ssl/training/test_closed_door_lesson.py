"""Doors of scans are closed, and views of them kept: in states that training does not show, and as cameras see them."""

from dataclasses import replace

import pytest
import roma
import torch
from boxes_with_doors import PIVOT, ZERO
from scanned_boxes import SEEN, found_elsewhere, module_of_boxes

from articulate_ssl.discovery import reshaping
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.ops.chamfer import nearest_distance
from articulate_ssl.training.closed_door_lesson import learn_closed_doors


@pytest.fixture
def module():
    """What the lesson needs of one."""
    return module_of_boxes()


@pytest.mark.parametrize("elsewhere", [False, True])
def test_views_show_doors_from_closed_to_where_training_begins(module, monkeypatch, elsewhere):
    monkeypatch.setattr(reshaping, "_SPREAD", 0.0)  # of the very object, whose shape is known
    if elsewhere:
        turn = roma.random_rotmat(1, generator=torch.Generator().manual_seed(1))[0]
        module.scans = found_elsewhere(module.scans, se3(turn, torch.zeros(3)))
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


def test_an_earlier_runs_views_are_forgotten(module):
    learn_closed_doors(module, None)
    module.part_frames.flat.fill_(False)
    learn_closed_doors(module, None)
    assert not module.estimator.closed_views.learnt and module.asked == 1


def test_a_door_without_faces_is_closed_by_the_box_about_it(module):
    module.part_frames.flat[1] = False
    module.part_frames.axes[1] = torch.eye(3)
    learn_closed_doors(module, None)
    assert module.estimator.closed_views.learnt
    assert float(module.states.rest) == pytest.approx(ZERO, abs=0.05)


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
    shape = replace(module.scans.found.shape, joints=replace(joints, **{what: other}))
    module.scans = replace(module.scans, found=replace(module.scans.found, shape=shape))
    learn_closed_doors(module, None)
    assert not module.estimator.closed_views.learnt and "found the hinge elsewhere" in caplog.text
    assert not module.states.rests
