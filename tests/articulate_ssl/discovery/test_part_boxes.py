"""Parts fill the boxes of their points: stretches, places and offsets are read off."""

from dataclasses import replace

import torch
from articulated_objects import CHEST, clouds, true_shape

from articulate_ssl.discovery.instance_fit import InstanceFit
from articulate_ssl.discovery.part_boxes import fit_part_boxes


def _drawn(count: int = 5):
    """A shape, and what the instance fit makes of it with drawn parameters: the clouds, their parts, the fit."""
    data = clouds(CHEST, count=count, points=1500, rotate=False)
    shape = true_shape(CHEST, data).with_centred_pivots()
    generator = torch.Generator().manual_seed(0)

    def draw(*size: int) -> torch.Tensor:
        return 2 * torch.rand(size, generator=generator) - 1

    base = torch.eye(4).repeat(count, 1, 1)
    base[:, :3, 3] = 0.3 * draw(count, 3)
    beside = 0.1 * draw(count, 3, 3)
    beside[:, 0], beside[..., 0] = 0, 0
    axes = torch.eye(3).expand(3, 3, 3)
    fit = InstanceFit(shape, base, 0.15 * draw(count, 2), generator, axes, 0.25 * draw(count, 3, 3), beside)
    return shape, fit.posed(), shape.label.expand(count, -1), fit


def test_what_was_drawn_is_read_off():
    shape, points, part, truth = _drawn()
    found = fit_part_boxes(shape, points, part)
    torch.testing.assert_close(found.posed(), points, atol=1e-3, rtol=0)
    torch.testing.assert_close(found.base, truth.base, atol=1e-3, rtol=0)
    torch.testing.assert_close(found.log_stretch, truth.log_stretch, atol=1e-3, rtol=0)
    # How far a part has slid and where else it lies are told apart by another rule than the one they were drawn by.
    displaced, drawn = (one.beside[:, 1:] + one.state[..., None] * shape.joints.axis for one in (found, truth))
    torch.testing.assert_close(displaced, drawn, atol=1e-3, rtol=0)


def test_states_are_how_far_middles_are_from_the_body():
    data = clouds(CHEST, count=8, points=1500, rotate=False)
    shape, part = true_shape(CHEST, data), data.part.expand(8, -1)  # whose pivots are not in the middle of drawers
    points = data.points.clone()
    for k in (1, 2):  # drawers that are as far out, and deeper
        own = points[:, data.part == k]
        middle = (own.amin(dim=1) + own.amax(dim=1))[:, None] / 2
        points[:, data.part == k] = middle + torch.tensor([1.2, 1.1, 0.9]) * (own - middle)
    found = fit_part_boxes(shape, points, part)
    torch.testing.assert_close(found.state, data.state, atol=0.01, rtol=0)
    limited = replace(shape, joints=replace(shape.joints, limits=torch.tensor([[-0.01, 0.01]] * 2)))
    held = fit_part_boxes(limited, points, part)
    assert held.state.abs().max() <= 0.01
    torch.testing.assert_close(held.posed(), found.posed())  # parts are where they are seen all the same


def test_some_wrong_labels_do_little():
    shape, points, part, _ = _drawn()
    wrong = torch.rand(part.shape, generator=torch.Generator().manual_seed(1)) < 0.02
    found = fit_part_boxes(shape, points, torch.where(wrong, (part + 1) % 3, part))
    right = fit_part_boxes(shape, points, part).state
    assert (found.state - right).abs().median() < 0.02
    assert (fit_part_boxes(shape, points, (part + 1) % 3).state - right).abs().median() > 0.02


def test_a_part_without_points_stays_where_the_shape_has_it():
    shape, points, part, _ = _drawn()
    found = fit_part_boxes(shape, points, torch.where(part == 2, 0, part))
    assert found.posed().isfinite().all()
    assert (found.state[:, 1] == 0).all() and (found.beside[:, 2] == 0).all() and (found.log_stretch[:, 2] == 0).all()


def test_stretches_are_bounded_and_parts_stay_at_their_centres():
    shape, points, part, _ = _drawn(1)
    found = fit_part_boxes(shape, 3 * points, part)
    assert float(found.log_stretch.max()) < 0.36
    for k in range(3):
        boxes = (
            torch.quantile(some[0][part[0] == k], torch.tensor([0.03, 0.97]), dim=0)
            for some in (found.posed(), 3 * points)
        )
        middle, truth = (box.mean(dim=0) for box in boxes)
        torch.testing.assert_close(middle, truth, atol=1e-2, rtol=0)


def _views(count: int):
    """A chest, and clouds that show of its drawers the front third of their depth alone, and of its body all."""
    data = clouds(CHEST, count=count, points=1500, rotate=False)
    shape = true_shape(CHEST, data)
    depth = data.rest[:, 0]
    seen = (data.part == 0) | (depth > 0.28)
    return data, shape, data.points[:, seen], data.part[seen].expand(count, -1)


def test_where_views_show_fronts_states_are_how_far_these_are_from_the_bodys():
    data, shape, points, part = _views(8)
    fronts = torch.ones(2)
    found = fit_part_boxes(shape, points, part, fronts)
    torch.testing.assert_close(found.state, data.state, atol=0.02, rtol=0)
    torch.testing.assert_close(found.posed(), data.points, atol=0.03, rtol=0)  # what is not seen is there, too
    assert (fit_part_boxes(shape, points, part).state - data.state).abs().mean() > 0.05
    assert (fit_part_boxes(shape, points, part, -fronts).state - data.state).abs().mean() > 0.05
    back = replace(shape, joints=replace(shape.joints, axis=-shape.joints.axis))
    torch.testing.assert_close(fit_part_boxes(back, points, part, -fronts).state, -found.state)


def test_a_body_of_which_one_side_is_seen_is_as_wide_as_the_whole_object():
    data, shape, points, part = _views(4)
    one_side = (part[0] != 0) | (shape.points[:, 1][(data.part == 0) | (data.rest[:, 0] > 0.28)] < 0.3)
    assert not one_side.all()
    found = fit_part_boxes(shape, points[:, one_side], part[:, one_side], torch.ones(2))
    width = found.posed()[:, data.part == 0, 1].amax(dim=1) - found.posed()[:, data.part == 0, 1].amin(dim=1)
    assert width.min() > 0.5  # of .6; the drawers are .5 wide, and what is seen of the body .3
