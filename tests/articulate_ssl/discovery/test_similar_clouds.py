"""Clouds that are most like a cloud say which part its points are of."""

import torch
from articulated_objects import chest_of_height, clouds

from articulate_ssl.discovery.similar_clouds import LabelledClouds
from articulate_ssl.discovery.synchronization import unit_boxes
from articulate_ssl.geometry.se3 import invert_se3, transform_points


def _standing(height: float, count: int, seed: int):
    """Unit boxes [n, 768, 3] of such chests, and which part their points are of."""
    data = clouds(chest_of_height(height), count=count, points=768, resample=True, seed=seed)
    return unit_boxes(transform_points(invert_se3(data.base), data.points))[0], data.part.expand(count, -1)


def _gallery(heights, count: int = 6) -> LabelledClouds:
    boxes, parts = zip(*(_standing(height, count, seed) for seed, height in enumerate(heights)), strict=True)
    return LabelledClouds(torch.cat(boxes), torch.cat(parts))


def _right(labelled: LabelledClouds, boxes, part) -> float:
    return float((labelled.votes(boxes, 3).argmax(dim=-1) == part).float().mean())


def test_chests_alike_label_better_than_others():
    boxes, part = _standing(0.2, 4, seed=10)
    both, others = _gallery((0.2, 0.42)), _gallery((0.42,))
    assert _right(both, boxes, part) > 0.9
    assert _right(others, boxes, part) < 0.85


def test_votes_are_shares_and_do_not_depend_on_the_order_of_the_gallery():
    labelled, (boxes, _) = _gallery((0.2, 0.42)), _standing(0.3, 2, seed=11)
    votes = labelled.votes(boxes, 3)
    torch.testing.assert_close(votes.sum(dim=-1), torch.ones(2, 768))
    order = torch.randperm(12, generator=torch.Generator().manual_seed(0))
    other = LabelledClouds(labelled.points[order], labelled.part[order])
    torch.testing.assert_close(other.votes(boxes, 3), votes)


def test_other_points_of_the_clouds_can_be_asked_for_and_few_clouds_will_do():
    labelled, (boxes, part) = _gallery((0.2,), count=3), _standing(0.2, 2, seed=12)
    asked = labelled.votes(boxes[:, :300], 3, boxes[:, 500:])
    assert asked.shape == (2, 268, 3)
    assert (asked.argmax(dim=-1) == part[:, 500:]).float().mean() > 0.85
