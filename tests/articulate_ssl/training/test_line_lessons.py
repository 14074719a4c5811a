"""The category's joint lines go where both parts are, and clouds are explained anew until they stay.

And they become parallel to the body where they nearly are.
"""

from dataclasses import replace

import pytest
import roma
import torch
from articulated_objects import GLASSES, OVEN, clouds, true_hypotheses
from tiny import POINTS, tiny_module

from articulate_ssl.inference.options import InferenceOptions
from articulate_ssl.training import line_lessons
from articulate_ssl.training.line_lessons import learn_joint_axes, learn_joint_lines

OFF = torch.tensor([[0.1, 0.0, -0.08]])


def _module():
    module = tiny_module(inference=InferenceOptions(proportions=0, points=POINTS)).eval()
    module.num_points = POINTS
    return module


def _learnt(monkeypatch, off):
    """What the lesson leaves of lines that are off, and how often clouds were explained anew."""
    module, data = _module(), clouds(OVEN, count=12, points=1500, resample=True)
    truth, asked = true_hypotheses(OVEN, data), []
    left = [off.clone()]

    def off_line(rows):
        one = truth.rows(rows)
        return replace(one, structure=replace(one.structure, pivot=one.pivot + left[0]))

    def move_lines(shift, state):
        torch.testing.assert_close(state, truth.state[:, 0].median(dim=0).values)
        left[0] = left[0] + shift

    def explained(points, num_points, dense):
        assert points.shape[1] == POINTS and dense.shape[1] == 1500
        asked.append(len(points))
        return off_line(torch.arange(len(points)))

    monkeypatch.setattr(module.estimator, "explained", explained)
    monkeypatch.setattr(module.articulated.category, "move_lines", move_lines)
    monkeypatch.setattr(line_lessons, "_BATCH", 12)
    found = learn_joint_lines(module, off_line(torch.arange(12)), data.points)
    torch.testing.assert_close(found.pivot, truth.pivot + left[0])
    return left[0], len(asked)


def test_lines_are_moved_until_they_stay(monkeypatch):
    left, times = _learnt(monkeypatch, OFF)
    assert left.norm() < 0.05 < OFF.norm()
    assert 1 <= times < 3


def test_lines_that_are_right_stay(monkeypatch):
    left, times = _learnt(monkeypatch, torch.zeros(1, 3))
    assert not left.any() and not times


def _axes_learnt(monkeypatch, degrees, body=None):
    """Of glasses whose joints are so far off: the axes that the category is given, and the true ones."""
    module, data = _module(), clouds(GLASSES, count=12, points=1500, resample=True)
    truth, given = true_hypotheses(GLASSES, data), []
    tilt = roma.rotvec_to_rotmat(torch.tensor([0.0, 1.0, 0.0]) * torch.tensor(degrees).deg2rad())
    one = replace(truth, structure=replace(truth.structure, axis=truth.axis @ tilt.mT))
    views = data.points.clone()
    if body is not None:
        views[:, data.part == 0] = body
    monkeypatch.setattr(module.articulated.category, "turn_lines", given.append)
    assert learn_joint_axes(module, one, views) == bool(given)
    return given, truth.axis[0, 0]


def test_joints_that_are_nearly_parallel_to_the_body_become_so(monkeypatch):
    (axes,), truth = _axes_learnt(monkeypatch, 4.5)
    assert (axes * truth).sum(dim=-1).acos().rad2deg().max() < 1.5
    torch.testing.assert_close(axes.norm(dim=-1), torch.ones(2))


@pytest.mark.parametrize("degrees", [1.0, 15.0])  # no news, and no coincidence
def test_others_stay(monkeypatch, degrees):
    assert not _axes_learnt(monkeypatch, degrees)[0]


def test_a_round_body_says_nothing(monkeypatch):
    round_body = 0.1 * torch.randn(12, 500, 3, generator=torch.Generator().manual_seed(0))
    assert not _axes_learnt(monkeypatch, 4.5, round_body)[0]


def test_where_no_point_is_of_the_body_nothing_is_learnt():
    module, data = _module(), clouds(GLASSES, count=2, points=300)
    one, legs = true_hypotheses(GLASSES, data), data.points[:, data.part != 0]
    away = replace(one, shape=one.shape._replace(assembly=one.assembly + 9 * torch.eye(3)[:1]))
    assert not learn_joint_axes(module, away, legs)


def test_a_category_takes_directions_over():
    category = _module().articulated.category
    pivot = category.articulated_shape(0).joints.pivot
    category.turn_lines(torch.tensor([[0.0, 0.6, 0.8]]))
    joints = category.articulated_shape(0).joints
    torch.testing.assert_close(joints.axis, torch.tensor([[0.0, 0.6, 0.8]]))
    assert torch.equal(joints.pivot, pivot)
