"""Farthest-point order against its definition."""

from __future__ import annotations

import numpy as np
import pytest

from render.farthest_point import farthest_point_order, farthest_points_first


def worst_shortfall(points: np.ndarray, order: np.ndarray) -> float:
    """How much nearer, relatively, any chosen point was to those before it than the farthest point."""
    distance, worst = np.full(len(points), np.inf), 0.0
    for number, index in enumerate(order):
        if number:
            worst = max(worst, 1 - distance[index] / distance.max())
        distance = np.minimum(distance, np.linalg.norm(points - points[index], axis=1))
    return worst


@pytest.mark.parametrize(("size", "count"), [(1, 1), (10, 10), (63, 30), (64, 64), (500, 200), (3000, 300)])
def test_every_point_is_a_farthest_one(size, count):
    points = np.random.default_rng(size).normal(size=(size, 3)) * [1, 1, 0.01]
    order = farthest_point_order(points, count)
    assert len(set(order.tolist())) == count
    assert worst_shortfall(points.astype(np.float32), order) < 1e-5


def test_order_is_a_function_of_the_points():
    points = np.random.default_rng(0).normal(size=(1000, 3))
    np.testing.assert_array_equal(farthest_point_order(points, 100), farthest_point_order(points.copy(), 100))


def test_duplicate_points_are_each_chosen_once():
    order = farthest_point_order(np.repeat(np.eye(3), 30, axis=0), 90)
    assert sorted(order.tolist()) == list(range(90))


def test_first_points_are_ordered_and_none_is_lost():
    points = np.random.default_rng(1).normal(size=(400, 3))
    order = farthest_points_first(points, 100)
    assert sorted(order.tolist()) == list(range(400))
    assert worst_shortfall(points.astype(np.float32), order[:100]) < 1e-5


def test_too_few_points():
    with pytest.raises(ValueError, match="choose 5 of 4"):
        farthest_point_order(np.zeros((4, 3)), 5)
