"""Chamfer distance against the whole matrix under autograd."""

import pytest
import torch

from articulate_ssl.ops import reference
from articulate_ssl.ops.chamfer import (
    _TILE_ELEMENTS,
    chamfer,
    hypothesis_distances,
    nearest_distance,
    nearest_index,
    nearest_squared_distance,
)


@pytest.fixture
def clouds():
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(2, 3, 50, 3, dtype=torch.float64, generator=generator, requires_grad=True)
    target = torch.randn(2, 3, 70, 3, dtype=torch.float64, generator=generator, requires_grad=True)
    return points, target


@pytest.mark.parametrize("squared", [False, True])
@pytest.mark.parametrize("bidirectional", [False, True])
@pytest.mark.parametrize("weighted", [False, True])
def test_values_and_gradients_equal_the_reference(clouds, squared, bidirectional, weighted):
    weight = torch.rand(2, 3, 50, dtype=torch.float64) if weighted else None
    results = []
    for function in (chamfer, reference.chamfer):
        value = function(*clouds, squared=squared, bidirectional=bidirectional, weight=weight)
        results.append((value, *torch.autograd.grad(value.sum(), clouds)))
    for fast, slow in zip(*results, strict=True):
        torch.testing.assert_close(fast, slow, rtol=1e-9, atol=1e-12)


def test_nearest_index_is_right_across_tiles(monkeypatch, clouds):
    points, target = clouds
    expected = torch.cdist(points, target).argmin(dim=-1)
    for budget in (1, 70, 400, 10_000, 10_000_000):
        monkeypatch.setitem(_TILE_ELEMENTS, "cpu", budget)
        assert torch.equal(nearest_index(points, target), expected)
        torch.testing.assert_close(nearest_distance(points, target), torch.cdist(points, target).amin(dim=-1))


def test_excluded_points_are_not_nearest(monkeypatch, clouds):
    points, target = (cloud.detach().float() for cloud in clouds)
    excluded = torch.rand(2, 3, 70, generator=torch.Generator().manual_seed(1)) < 0.8
    distance = torch.cdist(points, target).masked_fill(excluded[:, :, None], torch.inf)
    for budget in (70, 10_000_000):
        monkeypatch.setitem(_TILE_ELEMENTS, "cpu", budget)
        index = nearest_index(points, target, excluded)
        assert not excluded.gather(2, index).any()
        found = distance.gather(3, index[..., None]).squeeze(3)
        torch.testing.assert_close(found, distance.amin(dim=-1), rtol=1e-4, atol=0)


def test_far_from_the_origin_float32_keeps_its_accuracy():
    points, target = torch.rand(2, 1, 200, 3).unbind(0)
    moved = nearest_squared_distance(points + 100, target + 100).sqrt()
    assert (moved - nearest_squared_distance(points, target).sqrt()).abs().max() < 1e-4


def test_gradient_is_finite_where_points_coincide():
    points = torch.rand(1, 5, 3, requires_grad=True)
    chamfer(points, points.detach().clone()).sum().backward()
    assert torch.isfinite(points.grad).all()


@pytest.mark.parametrize("bidirectional", [False, True])
@pytest.mark.parametrize("squared", [False, True])
def test_hypothesis_distances_equal_one_chamfer_per_hypothesis(bidirectional, squared):
    points = torch.rand(2, 40, 3)
    posed = torch.rand(2, 7, 30, 3)
    expected = chamfer(points[:, None].expand(-1, 7, -1, -1), posed, squared, bidirectional)
    torch.testing.assert_close(hypothesis_distances(points, posed, squared, bidirectional), expected)
