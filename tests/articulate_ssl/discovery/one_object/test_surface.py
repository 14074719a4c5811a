"""Distances along normals, against the readable definition, and what they are good for."""

import numpy as np
import pytest

from articulate_ssl.discovery.one_object.surface import Surface


def _plane(height: float, count: int = 2000, seed: int = 0) -> Surface:
    """Samples of a unit square across z."""
    across = np.random.default_rng(seed).random((count, 2))
    return Surface.of(np.column_stack([across, np.full(count, height)]))


def test_normals_of_a_plane_stand_on_it():
    np.testing.assert_allclose(np.abs(_plane(0.3).normals), np.tile([0, 0, 1], (2000, 1)), atol=1e-6)


@pytest.mark.parametrize("height", [0.0, 0.003, 0.01])
def test_the_distance_of_two_samples_of_a_plane_is_that_of_the_planes(height):
    """Nearest samples are half a spacing apart, whatever the height."""
    low, high = _plane(0.0), _plane(height, seed=1)
    inside = (high.points[:, :2] > 0.1).all(axis=1) & (high.points[:, :2] < 0.9).all(axis=1)
    distance = low.nearest(high, cap=0.02)[inside]
    # Where random samples leave a gap, a query is past the edge of the face.
    np.testing.assert_allclose(np.quantile(distance, [0.0, 0.9]), height, atol=1e-6)
    assert low.tree.query(high.points)[0][inside].mean() > height + 0.001


def test_beyond_the_edge_the_distance_grows_to_the_cap():
    plane = _plane(0.0)
    points = np.array([[0.5, 0.5, 0.0], [1.3, 0.5, 0.0]])
    distance = plane.nearest(Surface(points, np.tile([0.0, 0.0, 1.0], (2, 1))), cap=0.02)
    assert distance[0] < 1e-6 and distance[1] == 0.02


def test_a_face_that_crosses_is_another_surface():
    plane = _plane(0.0)
    query = Surface(np.array([[0.5, 0.5, 0.0]]), np.array([[1.0, 0.0, 0.0]]))
    assert plane.nearest(query, cap=0.02) == 0.02


def test_a_moved_surface_is_as_far_from_a_moved_cloud():
    rng = np.random.default_rng(0)
    surface, query = Surface.of(rng.random((500, 3))), Surface.of(rng.random((50, 3)))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.linalg.qr(rng.standard_normal((3, 3)))[0], [1, 2, 3]
    before, after = (s.nearest(q, 0.1) for s, q in ((surface, query), (surface.moved(pose), query.moved(pose))))
    np.testing.assert_allclose(before, after, atol=1e-9)


def test_a_point_lies_on_the_sample_below_it_that_faces_as_it_does_or_on_none():
    plane, up, aside = _plane(0.0), [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]
    near = plane.points[[7, 30]] + np.array([0, 0, 1e-4])
    far = np.array([[0.5, 0.5, 1.0]])
    query = Surface(np.concatenate([near, far, near[:1]]), np.array([up, up, up, aside]))
    assert plane.under(query).tolist() == [7, 30, len(plane.points), len(plane.points)]
