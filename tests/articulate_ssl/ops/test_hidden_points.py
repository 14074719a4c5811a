"""What a camera sees of sampled surfaces."""

import numpy as np
import pytest

from articulate_ssl.ops import hidden_points
from articulate_ssl.ops.hidden_points import seen_from_origin


def _box(count: int = 4096, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """The surface of a cube of width 1 about (0, 0, 2.5), and its normals, of either sign."""
    random = np.random.default_rng(seed)
    points, normals = random.uniform(-0.5, 0.5, (count, 3)), np.zeros((count, 3))
    axis = random.integers(0, 3, count)
    points[np.arange(count), axis] = random.choice([-0.5, 0.5], count)
    normals[np.arange(count), axis] = random.choice([-1, 1], count)
    return points + np.array([0, 0, 2.5]), normals


def _plate(random: np.random.Generator, side: int, half: float, depth: float) -> tuple[np.ndarray, np.ndarray]:
    """A square that faces the camera, of side^2 points about as evenly spread as farthest-point sampling does it."""
    grid = np.stack(np.meshgrid(*[np.arange(side)] * 2), axis=-1).reshape(-1, 2)
    grid = (grid + random.uniform(0.2, 0.8, grid.shape)) / side
    return np.c_[half * (2 * grid - 1), np.full(len(grid), depth)], np.tile([0.0, 0, 1], (len(grid), 1))


def test_of_a_box_the_front_is_seen_and_the_back_is_not():
    points, normals = _box()
    seen = np.zeros(len(points), bool)
    seen[seen_from_origin(points, normals)] = True
    front, back = points[:, 2] < 2.001, points[:, 2] > 2.999
    assert seen[front].mean() > 0.95 and seen[back].mean() < 0.01
    side = ~front & ~back  # all four lie behind the front, as the camera is before its middle
    assert seen[side].mean() < 0.1


def test_slanted_faces_are_seen():
    points, normals = _box()
    turn = np.array([[np.cos(1.0), 0, np.sin(1.0)], [0, 1, 0], [-np.sin(1.0), 0, np.cos(1.0)]])
    middle = np.array([0, 0, 2.5])
    turned = (points - middle) @ turn.T + middle
    seen = np.zeros(len(points), bool)
    seen[seen_from_origin(turned, normals @ turn.T)] = True
    for face in (points[:, 0] > 0.499, points[:, 2] < 2.001):
        assert seen[face].mean() > 0.9
    assert seen[(points[:, 0] < -0.499) | (points[:, 2] > 2.999)].mean() < 0.02


def test_what_stands_before_another_hides_it():
    random = np.random.default_rng(0)
    (plate, ahead), (wall, behind) = _plate(random, 39, 0.3, 2.0), _plate(random, 63, 1.0, 4.0)
    seen = seen_from_origin(np.concatenate([plate, wall]), np.concatenate([ahead, behind]))
    on_wall = wall[seen[seen >= len(plate)] - len(plate)]
    assert (seen < len(plate)).sum() > 0.9 * len(plate)
    shadow = np.abs(wall[:, :2]).max(axis=1) < 0.5  # twice as far, so of twice the width
    assert (np.abs(on_wall[:, :2]).max(axis=1) < 0.5).sum() < 0.05 * shadow.sum()


def test_what_is_as_near_behind_as_samples_are_apart_is_hidden():
    random = np.random.default_rng(0)
    (front, ahead), (inner, behind) = _plate(random, 25, 0.5, 2.0), _plate(random, 25, 0.5, 2.03)
    points, normals = np.concatenate([front, inner]), np.concatenate([ahead, behind])
    turn = np.array([[np.cos(0.7), 0, np.sin(0.7)], [0, 1, 0], [-np.sin(0.7), 0, np.cos(0.7)]])
    middle = np.array([0, 0, 2.0])
    points, normals = (points - middle) @ turn.T + middle, normals @ turn.T
    through = (hidden_points._on_the_hull(points) >= len(front)).mean()
    seen = seen_from_origin(points, normals)
    assert through > 0.03 and (seen >= len(front)).mean() < 0.005
    assert (seen < len(front)).sum() > 0.95 * len(front)


@pytest.mark.parametrize("scale", [0.1, 30.0])
def test_units_do_not_matter(scale):
    points, normals = _box(500)
    assert np.array_equal(seen_from_origin(points, normals), seen_from_origin(scale * points, normals))
