"""Where the hinges of laptops are, predictions of training clouds say."""

import math
from dataclasses import replace

import pytest
import torch
from synthetic_predictions import laptop
from tiny import POINTS, tiny_module

from articulate_ssl.inference.options import InferenceOptions
from articulate_ssl.inference.prediction import concatenate
from articulate_ssl.training import contact_lesson
from articulate_ssl.training.contact_lesson import learn_closed_contact
from articulate_ssl.training.lessons import plan

CLOSED, ACROSS = 0.2, 0.03  # joint state of closed laptops; how far predicted hinges are off, across lids


@pytest.fixture
def taught(monkeypatch):
    """A module, training clouds of laptops, and what is predicted of them."""
    module = tiny_module(inference=InferenceOptions(refine=True, points=POINTS)).eval()
    module.num_points = POINTS
    made = [laptop(math.radians(15 + 2 * index), points=2048, seed=index) for index in range(40)]
    found = concatenate(
        [replace(one, dense_part_id=one.part_id, joint_state=one.joint_state + CLOSED) for one, _ in made]
    )
    across = -found.part_pose[:, 1, :3, 2]
    found = replace(found, joint_pivot=found.joint_pivot + ACROSS * across[:, None])
    rows = iter(torch.arange(40).split(16))
    monkeypatch.setattr(module.estimator, "predict", lambda *_, dense: found[next(rows)])
    monkeypatch.setattr(contact_lesson, "closed_state", lambda *_: CLOSED)
    monkeypatch.setattr(contact_lesson, "_thickness", lambda _: 0.1)
    return module, torch.stack([points for _, points in made])


def test_they_are_where_closed_lids_lie_on_bases(taught):
    module, clouds = taught
    learn_closed_contact(module, clouds)
    plates = module.estimator.closed_plates
    assert plates.learnt and module.estimator.closes
    assert float(plates.closed) == pytest.approx(CLOSED)
    torch.testing.assert_close(plates.off, torch.tensor([-ACROSS, 0.0]), atol=0.012, rtol=0)


def test_states_are_as_predictions_count_them(taught):
    module, clouds = taught
    module.hinge_sides.learnt.fill_(True)
    module.hinge_sides.closed.fill_(CLOSED)
    learn_closed_contact(module, clouds)
    assert float(module.estimator.closed_plates.closed) == pytest.approx(0, abs=1e-6)


def test_few_clouds_say_nothing(taught):
    module, clouds = taught
    module.estimator.closed_plates.learnt.fill_(True)  # of a run that ended and goes on
    learn_closed_contact(module, clouds[:16])
    assert not module.estimator.closed_plates.learnt and not module.estimator.closes


@pytest.mark.parametrize("what", ["boxes", "what slides"])
def test_other_things_are_not_asked(taught, monkeypatch, what):
    module, clouds = taught
    if what == "boxes":
        monkeypatch.setattr(contact_lesson, "_thickness", lambda _: 0.5)
    else:
        module.articulated.joint_type = 1
    monkeypatch.setattr(module.estimator, "predict", lambda *_, **__: pytest.fail("predicted in vain"))
    learn_closed_contact(module, clouds)
    assert not module.estimator.closed_plates.learnt


def test_plates_are_thin():
    generator = torch.Generator().manual_seed(0)
    plate = torch.rand(200, 3, generator=generator) * torch.tensor([1.0, 0.8, 0.1])
    box = torch.rand(200, 3, generator=generator) * torch.tensor([1.0, 0.8, 0.6])
    assert contact_lesson._thickness(plate) < contact_lesson._THIN < contact_lesson._thickness(box)


def test_it_is_no_lesson_of_views():
    module = tiny_module(inference=InferenceOptions(refine=True, points=POINTS))
    assert plan(module)["closed_contact"].samples
    views = tiny_module(inference=InferenceOptions(refine=True, points=POINTS), orientation_range=100.0)
    assert not plan(views)["closed_contact"].samples
