"""The category's joint lines go where both parts are, and clouds are explained anew until they stay."""

from dataclasses import replace

import torch
from articulated_objects import OVEN, clouds, true_hypotheses
from tiny import POINTS, tiny_module

from articulate_ssl.inference.options import InferenceOptions
from articulate_ssl.training import line_lessons
from articulate_ssl.training.line_lessons import learn_joint_lines

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
