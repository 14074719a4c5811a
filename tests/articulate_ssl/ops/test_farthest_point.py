import numpy as np
import pytest

from articulate_ssl.ops.farthest_point import farthest_point_order


def test_any_beginning_of_the_order_is_an_even_sample():
    points = np.random.default_rng(0).random((2000, 3)) ** 3  # dense in one corner
    order = farthest_point_order(points, 200)
    assert len(set(order.tolist())) == 200
    gaps = np.linalg.norm(points[:, None] - points[order[:50]], axis=2).min(axis=1)
    random_gaps = np.linalg.norm(points[:, None] - points[:50], axis=2).min(axis=1)
    assert gaps.max() < 0.6 * random_gaps.max()


def test_farthest_point_order_is_greedy():
    points = np.random.default_rng(0).random((60, 3)).astype(np.float32)
    order = farthest_point_order(points, 20)
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    for i in range(1, 20):
        assert distance[order[:i]].min(axis=0)[order[i]] == pytest.approx(distance[order[:i]].min(axis=0).max())
