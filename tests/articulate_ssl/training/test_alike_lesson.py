"""Clouds of boxes are kept as predictions turn them, and say how others are turned."""

from dataclasses import replace

import pytest
import torch
from boxes_with_doors import HINGE
from predicted_boxes import REST, predicted_boxes, predicting_module

from articulate_ssl.discovery.manhattan_frame import manhattan_frames
from articulate_ssl.inference.hinge_sides import HingeSides
from articulate_ssl.training import alike_lesson
from articulate_ssl.training.alike_lesson import learn_alike_boxes


@pytest.fixture(autouse=True)
def _few(monkeypatch):
    monkeypatch.setattr(alike_lesson, "FEWEST", 24)


def _turned_over(found, rows):
    """Predictions of which some are upside down."""
    base = found.base_pose.clone()
    base[rows, :3, :2] *= -1
    return replace(found, base_pose=base)


@pytest.mark.parametrize("opened", [1.2, 0.1])
def test_boxes_turn_as_those_most_alike_whatever_few_predictions_got_wrong(opened):
    """With their doors nearly closed, too, as none of them was."""
    found, dense, _ = predicted_boxes(48)
    module = predicting_module(_turned_over(found, torch.tensor([3, 17, 30])), dense)
    module.estimator.hinge_sides.learnt.fill_(False)
    module.estimator.states.set_rest(float(REST))
    learn_alike_boxes(module, dense)
    turns = module.estimator.box_turns
    assert module.estimator.square_search.measured and turns.learnt and turns.surface is None
    assert len(turns.alike.gallery) == 96 and turns.alike.weight > 0
    found, dense, _ = predicted_boxes(12, opened)
    frames, _ = manhattan_frames(dense, torch.Generator().manual_seed(0))
    looks = turns.looks(dense, frames)
    rotation = looks.rotation[torch.arange(12), looks.alike.argmax(dim=1)]
    assert ((rotation * found.base_pose[:, :3, :3]).sum(dim=(1, 2)) > 2.8).all()


def test_what_is_hinged_elsewhere_than_most_is_not_kept(monkeypatch):
    found, dense, _ = predicted_boxes(48)
    module, asked = predicting_module(found, dense), []
    monkeypatch.setattr(HingeSides, "hinged", lambda _, axis: (asked.append(axis), torch.arange(len(axis)) % 3)[1])
    learn_alike_boxes(module, dense[:40])
    assert not module.estimator.box_turns.learnt  # 14 are too few
    module = predicting_module(found, dense)
    monkeypatch.setattr(HingeSides, "hinged", lambda _, axis: torch.arange(len(axis)) % 3 // 2)
    learn_alike_boxes(module, dense)
    assert len(module.estimator.box_turns.alike.gallery) == 64
    torch.testing.assert_close(asked[0].abs(), HINGE.expand(40, 3), atol=1e-4, rtol=0)  # in canonical space


def test_predictions_that_agree_in_nothing_keep_nothing():
    found, dense, _ = predicted_boxes(48)
    generator = torch.Generator().manual_seed(0)
    order = torch.randperm(48, generator=generator)
    base = found.base_pose.clone()
    base[:, :3, :3] = base[order, :3, :3]
    module = predicting_module(replace(found, base_pose=base), dense)
    module.estimator.hinge_sides.learnt.fill_(False)
    learn_alike_boxes(module, dense)
    assert not module.estimator.box_turns.learnt


@pytest.mark.parametrize("known, count", [(False, 48), (True, 20)])
def test_what_is_no_box_or_hardly_seen_keeps_nothing(known, count):
    found, dense, _ = predicted_boxes(count)
    module = predicting_module(found, dense, known)
    module.estimator.box_turns.alike.learn(dense, 60.0)  # of a run that ended and goes on
    learn_alike_boxes(module, dense)
    assert not module.estimator.box_turns.learnt
