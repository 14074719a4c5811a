"""The camera: pixel centres, axes and view angles."""

from __future__ import annotations

import numpy as np
import pytest

from render.camera import FIELD_OF_VIEW, Camera, look_at_rotation, sample_view
from render.category import load_category


def test_pixels_are_seen_through_their_centres():
    camera = Camera(4)
    points = camera.back_project(np.arange(16), np.full(16, 2.0))
    np.testing.assert_allclose(points, 2 * camera.rays().reshape(16, 3), rtol=1e-6)
    np.testing.assert_allclose(points.mean(0), [0, 0, 2], atol=1e-12)
    half_width = 2 * np.tan(FIELD_OF_VIEW / 2)
    assert points[3, 0] == pytest.approx(half_width * 3 / 4), "centre of the last pixel, not its edge"


@pytest.mark.parametrize(
    ("azimuth", "elevation", "camera_at"),
    [(0, 0, [0, 0, 1]), (90, 0, [1, 0, 0]), (0, 90, [0, 1, 0]), (180, 0, [0, 0, -1])],
)
def test_camera_stands_where_the_angles_say(azimuth, elevation, camera_at):
    rotation = look_at_rotation(np.deg2rad(azimuth), np.deg2rad(elevation), 0.0)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_allclose(rotation @ camera_at, [0, 0, -1], atol=1e-12, err_msg="it looks at the object")


def test_front_view_has_up_upwards_and_the_right_side_on_the_right():
    rotation = look_at_rotation(0.0, 0.0, 0.0)
    np.testing.assert_allclose(rotation @ [0, 1, 0], [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(rotation @ [1, 0, 0], [1, 0, 0], atol=1e-12)


def test_roll_turns_the_camera_clockwise():
    """Up then points to the left of the image."""
    np.testing.assert_allclose(look_at_rotation(0.0, 0.0, np.pi / 2) @ [0, 1, 0], [-1, 0, 0], atol=1e-12)


def test_sampled_views_keep_the_object_in_the_image():
    rng, target = np.random.default_rng(0), np.array([1.0, 2.0, 3.0])
    for _ in range(20):
        rotation, translation = sample_view(load_category("laptop").view, target, 0.5, rng)
        x, y, distance = rotation @ target + translation
        assert (x, y) == pytest.approx((0, 0), abs=1e-9)
        assert distance * np.sin(FIELD_OF_VIEW / 2) >= 0.5
