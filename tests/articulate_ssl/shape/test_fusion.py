"""Clouds laid over each other: what most show stays, with the part with which it moves."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from articulated_objects import GLASSES, OVEN, Clouds, clouds, true_shape

from articulate_ssl.geometry.se3 import transform_points
from articulate_ssl.shape import fusion
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.fusion import FUSED_POINTS, fused
from articulate_ssl.shape.part_maps import PartMaps

NEAR = 0.03


def _data(design=OVEN) -> Clouds:
    return clouds(design, count=30, points=1200, resample=True, seed=3)


def _fused(shape: ArticulatedShape, data: Clouds) -> ArticulatedShape | None:
    return fused(shape, PartMaps.of(shape.joints.part_pose(data.base, data.state)), data.points)


def _beyond(points: torch.Tensor, design, part: int) -> float:
    """Share of points that are off the surface of a part's box."""
    low, high = (torch.tensor(corner) for corner in design[0][part])
    outside = torch.linalg.vector_norm((low - points).relu() + (points - high).relu(), dim=1)
    inside = torch.minimum(points - low, high - points).amin(dim=1).relu()
    return float((outside + inside > NEAR).float().mean())


@pytest.mark.parametrize("design", [OVEN, GLASSES])
def test_what_clouds_show_is_the_shape(design):
    data = _data(design)
    truth = true_shape(design, data)
    found = _fused(truth.thinned(300), data)
    assert found.points.shape == (FUSED_POINTS * truth.num_parts, 3)
    for part in range(truth.num_parts):
        assert len(found.part(part)) == FUSED_POINTS
        assert _beyond(found.part(part), design, part) < 0.02
        assert (torch.cdist(truth.part(part), found.part(part)).amin(dim=1) < 2 * NEAR).float().mean() > 0.97
        extent = [points.amax(dim=0) - points.amin(dim=0) for points in (truth.part(part), found.part(part))]
        assert (extent[1] - extent[0]).amin() > -0.006  # it does not shrink


def test_a_piece_of_another_part_moves_with_its_own():
    """Some of the oven's back wall is taken for the door."""
    data = _data()
    truth = true_shape(OVEN, data)
    wrong = (truth.points[:, 0] < 0.01) & (truth.points[:, 2] > 0.15) & (truth.points[:, 2] < 0.35)
    shape = replace(truth, label=torch.where(wrong, 1, truth.label))
    assert _beyond(shape.part(1), OVEN, 1) > 0.02
    found = _fused(shape, data)
    assert _beyond(found.part(1), OVEN, 1) < 0.002
    back = truth.points[wrong]
    assert (torch.cdist(back, found.part(0)).amin(dim=1) < 2 * NEAR).all()


def test_a_part_that_moves_is_in_one_piece():
    """Some of what is in the oven is taken for the door; wherever that moves to, there is something."""
    data = _data()
    truth, generator = true_shape(OVEN, data), torch.Generator().manual_seed(0)
    place = torch.rand(len(data.points), 4000, 3, generator=generator)
    inside = place * torch.tensor([0.4, 0.6, 0.5])
    points = torch.cat([data.points, transform_points(data.base, inside)], dim=1)
    wrong = ((inside[0, :, 2] - 0.2).abs() < 0.05) & (inside[0, :, 0] < 0.2)
    label = torch.cat([truth.label, wrong.long()])
    shape = replace(truth, points=torch.cat([truth.points, inside[0]]), label=label)
    found = _fused(shape, data._replace(points=points))
    assert _beyond(shape.part(1), OVEN, 1) > 0.05
    assert _beyond(found.part(1), OVEN, 1) < 0.002


def test_points_are_of_the_part_with_which_they_meet_other_clouds():
    """The nearer part moves them to where no other cloud has any; and what is far from a part is not of it."""
    back = [np.random.default_rng(0).random((20, 2, 3)), np.zeros((20, 2, 3))]
    distance = np.tile([[0.01, 0.05], [0.01, 0.5]], (20, 1, 1))
    assert fusion._labelled(distance, back).tolist() == [[1, 0]] * 20
    assert fusion._labelled(distance, back[:1] * 2).tolist() == [[0, 0]] * 20


def test_what_one_object_has_alone_goes():
    data = _data()
    truth = true_shape(OVEN, data)
    knob = torch.rand(60, 3) * 0.1 + torch.tensor([0.2, 0.2, 0.6])  # above the oven
    label = torch.cat([truth.label, torch.zeros(60, dtype=torch.long)])
    shape = replace(truth, points=torch.cat([truth.points, knob]), label=label)
    found = _fused(shape, data)
    assert _beyond(shape.part(0), OVEN, 0) > 0.05
    assert _beyond(found.part(0), OVEN, 0) < 0.02


def test_points_are_as_far_apart_on_every_part():
    """Most of them several times, where a part is small: the nearest point tells parts apart."""
    data = _data()
    found = _fused(true_shape(OVEN, data), data)
    gaps = []
    for part in range(2):
        points = found.part(part).unique(dim=0)
        gaps.append(float(torch.cdist(points, points).fill_diagonal_(1).amin(dim=1).median()))
    assert 0.8 < gaps[0] / gaps[1] < 1.25


def test_about_the_line_of_a_joint_the_shape_stays_as_it_was():
    data = _data()
    shape = true_shape(OVEN, data).thinned(400)
    found = _fused(shape, data)
    for part in range(2):
        old, new = shape.part(part), found.part(part)
        near = torch.linalg.vector_norm((new - shape.joints.pivot[0])[:, [0, 2]], dim=1) < fusion._NEAR_LINE
        assert near.any()
        assert (torch.cdist(new[near], old).amin(dim=1) < 1e-3).all()


def test_a_part_that_clouds_do_not_show_is_not_found():
    data = _data()
    shape = true_shape(OVEN, data)
    far = data._replace(points=data.points + 3)
    assert _fused(shape, far) is None
