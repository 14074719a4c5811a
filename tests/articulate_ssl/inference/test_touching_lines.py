"""A hinge is where both of its parts are."""

from dataclasses import replace

import pytest
import torch
from articulated_objects import GLASSES, LAPTOP, OVEN, clouds, true_hypotheses

from articulate_ssl.inference import touching_lines
from articulate_ssl.inference.touching_lines import shifts_to_touch

NEAR = 0.055  # parts are .02 to .05 thick, and where they are hardly farther lines stay


def _data(design):
    return clouds(design, count=12, points=1500, resample=True)


def _off(one, shift):
    """Explanations whose joint lines are elsewhere."""
    return replace(one, structure=replace(one.structure, pivot=one.pivot + shift))


def _across(one, shift, joint):
    """How far a line is moved by a shift [3]."""
    axis = one.axis[0, 0, joint]
    return float(torch.linalg.cross(shift, axis).norm())


BOXES = [(0.1, 0.06, -0.08), (-0.06, 0.09, 0.09)]  # beyond what sticks are wide, these would be taken for others


@pytest.mark.parametrize(
    ("design", "off"), [*((box, off) for box in (OVEN, LAPTOP) for off in BOXES), (GLASSES, (-0.06, 0.02, 0.05))]
)
def test_lines_go_back_to_where_parts_touch(design, off):
    data, off = _data(design), torch.tensor(off)
    one = true_hypotheses(design, data)
    shifts, apart = shifts_to_touch(_off(one, off), data.points)
    for joint, shift in enumerate(shifts):
        assert _across(one, off + shift, joint) < NEAR < _across(one, off, joint)
        assert apart[joint, 1] < apart[joint, 0] - 0.02


@pytest.mark.parametrize("design", [OVEN, GLASSES])
def test_lines_stay_where_parts_touch(design):
    data = _data(design)
    shifts, apart = shifts_to_touch(true_hypotheses(design, data), data.points)
    assert not shifts.any()
    assert (apart[:, 0] < NEAR).all()


@pytest.mark.parametrize("views", [False, True])
def test_in_views_parts_must_come_nearer_by_more(monkeypatch, views):
    data = _data(OVEN)
    one = true_hypotheses(OVEN, data)
    monkeypatch.setattr(touching_lines, "_nearest_line", lambda _: (torch.tensor([0.04, 0.0]), 0.05, 0.025))
    shifts, _ = shifts_to_touch(one, data.points, views)
    assert bool(shifts.any()) != views


def test_clouds_without_one_of_the_parts_say_nothing():
    data = _data(OVEN)
    one = true_hypotheses(OVEN, data)
    body = data.points[:, data.part == 0]
    away = one.at(one.base, torch.full_like(one.state, 1.5))
    shifts, apart = shifts_to_touch(_off(away, torch.tensor([0.1, 0.0, 0.1])), body[:, :7])
    assert not shifts.any() and not apart.any()
