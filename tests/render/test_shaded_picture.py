"""Pictures for people: framing and projection agree with what is drawn."""

import numpy as np
import pytest
from objects import box_laptop

from render.shaded_picture import frame, posed_vertices, shaded_picture


@pytest.mark.parametrize("azimuth", [-2.0, 0.0, 0.6])
def test_frame_just_fits_the_points(azimuth):
    points = np.random.default_rng(0).normal(size=(200, 3)) * (1.0, 0.2, 0.5) + (3.0, -1.0, 7.0)
    image = frame(points, azimuth=azimuth, elevation=0.4).project(points)
    assert np.abs(image).max() == pytest.approx(1 / 1.08, rel=1e-3)
    width = np.argmax(np.ptp(image, axis=0))
    assert image[:, width].max() == pytest.approx(-image[:, width].min(), rel=1e-3)


def test_pictures_show_the_object_where_the_viewpoint_projects_it():
    laptop, states, resolution = box_laptop(), np.array([1.2]), 200
    vertices = posed_vertices(laptop, states)
    viewpoint = frame(vertices)
    picture = shaded_picture(laptop, states, viewpoint, resolution)
    assert picture.shape == (resolution, resolution, 3) and picture.dtype == np.uint8
    drawn = np.argwhere((picture < 250).any(axis=-1))[:, ::-1]
    expected = (viewpoint.project(vertices) + 1) / 2 * resolution
    np.testing.assert_allclose(drawn.min(0), expected.min(0), atol=2.5)
    np.testing.assert_allclose(drawn.max(0), expected.max(0), atol=2.5)
    # The base is grey, the lid is not.
    saturation = np.ptp(picture.astype(int), axis=-1)[picture.min(-1) < 250]
    assert 0.1 < (saturation > 60).mean() < 0.9


def test_posed_vertices_follow_the_joint():
    laptop = box_laptop()
    closed, open_ = (posed_vertices(laptop, np.array([q])) for q in (0.0, np.pi / 2))
    np.testing.assert_allclose(closed[:8], open_[:8])
    assert closed[8:, 1].max() == pytest.approx(0.041)
    assert open_[8:, 1].max() == pytest.approx(0.0205 + 0.2)
