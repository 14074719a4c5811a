"""What a camera sees of sampled surfaces."""

import numpy as np
import pytest

from articulate_ssl.ops.hidden_points import seen_from_origin


def _box(count: int = 4096, seed: int = 0) -> np.ndarray:
    """The surface of a cube of width 1 about (0, 0, 2.5)."""
    random = np.random.default_rng(seed)
    points = random.uniform(-0.5, 0.5, (count, 3))
    axis = random.integers(0, 3, count)
    points[np.arange(count), axis] = random.choice([-0.5, 0.5], count)
    return points + np.array([0, 0, 2.5])


def test_of_a_box_the_front_is_seen_and_the_back_is_not():
    points = _box()
    seen = np.zeros(len(points), bool)
    seen[seen_from_origin(points)] = True
    front, back = points[:, 2] < 2.001, points[:, 2] > 2.999
    assert seen[front].mean() > 0.95 and seen[back].mean() < 0.01
    side = ~front & ~back  # all four lie behind the front, as the camera is before its middle
    assert seen[side].mean() < 0.1


def test_what_stands_before_another_hides_it():
    random = np.random.default_rng(0)
    wall = np.c_[random.uniform(-1, 1, (4000, 2)), np.full(4000, 4.0)]
    plate = np.c_[random.uniform(-0.3, 0.3, (1500, 2)), np.full(1500, 2.0)]
    seen = seen_from_origin(np.concatenate([plate, wall]))
    on_wall = wall[seen[seen >= 1500] - 1500]
    assert (seen < 1500).mean() > 0.2 and (seen < 1500).sum() > 1400
    shadow = np.abs(wall[:, :2]).max(axis=1) < 0.5  # twice as far, so of twice the width
    assert (np.abs(on_wall[:, :2]).max(axis=1) < 0.5).sum() < 0.05 * shadow.sum()


@pytest.mark.parametrize("scale", [0.1, 30.0])
def test_units_do_not_matter(scale):
    points = _box(500)
    assert np.array_equal(seen_from_origin(points), seen_from_origin(scale * points))
