import numpy as np
import pytest
import trimesh

from articulate_ssl.inference.pictures.part_colour import part_colour
from articulate_ssl.inference.pictures.surface import TRIANGLE_SIZE, cut_small, lit_triangles

HERE = np.eye(4)[None]


def at(*offset) -> np.ndarray:
    return trimesh.transformations.translation_matrix(offset)


def area(corners: np.ndarray) -> float:
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return float(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() / 2)


def test_small_triangles_cover_the_same_surface():
    box = trimesh.creation.box((1.0, 0.6, 0.02))
    (surface,) = cut_small([box], 1.0)
    assert trimesh.triangles.area(surface.corners).sum() == pytest.approx(box.area)
    edges = surface.corners - np.roll(surface.corners, 1, axis=1)
    assert np.linalg.norm(edges, axis=2).max() <= TRIANGLE_SIZE
    np.testing.assert_allclose(surface.normals, trimesh.triangles.normals(surface.corners)[0], atol=1e-6)


def test_slight_edges_are_rounded_and_sharp_ones_kept():
    (surface,) = cut_small([trimesh.creation.icosphere(subdivisions=1)], 2.0)
    radial = surface.corners.mean(axis=1)
    radial /= np.linalg.norm(radial, axis=1, keepdims=True)
    flat = trimesh.triangles.normals(surface.corners)[0]
    assert np.abs(surface.normals - radial).max() < 0.12 < np.abs(flat - radial).max()


def test_only_what_faces_the_viewer_is_drawn():
    triangles = lit_triangles(cut_small([trimesh.creation.box((1.0, 0.6, 0.3))], 1.0), HERE)
    assert area(triangles.corners) == pytest.approx(0.6)  # the one face towards z


def test_the_nearer_part_is_drawn_last_though_the_parts_are_in_another_order():
    plate = trimesh.creation.box((1.0, 1.0, 0.1))
    triangles = lit_triangles(cut_small([plate, plate], 1.0), np.stack([at(0, 0, 1), at(0, 0, 0)]))
    half = len(triangles.colour) // 2
    hue = triangles.colour / triangles.colour.max(axis=1, keepdims=True)
    for part, drawn in ((1, hue[:half]), (0, hue[half:])):
        colour = part_colour(part) / part_colour(part).max()
        np.testing.assert_allclose(drawn, np.broadcast_to(colour, drawn.shape), atol=0.2)


def test_a_part_that_is_in_front_with_one_end_only_is_hidden_at_the_other():
    """Two plates that cross: a depth per part could not draw them."""
    plate = trimesh.creation.box((1.0, 1.0, 0.02))
    lean = trimesh.transformations.rotation_matrix(0.5, (0, 1, 0))
    triangles = lit_triangles(cut_small([plate, plate], 1.0), np.stack([lean, lean.T]))
    middle = triangles.corners.mean(axis=1)
    blue = np.abs(triangles.colour[:, 2] - triangles.colour[:, 0]) * (triangles.colour[:, 2] > triangles.colour[:, 0])
    for side, part_0_in_front in ((-0.3, True), (0.3, False)):
        last = np.flatnonzero(np.linalg.norm(middle - [side, 0], axis=1) < 0.05)[-1]
        assert (blue[last] > 0) == part_0_in_front


def test_light_comes_from_above():
    box = cut_small([trimesh.creation.box((1.0, 1.0, 1.0))], 1.0)
    tip = trimesh.transformations.rotation_matrix(np.radians(40), (1, 0, 0))
    triangles = lit_triangles(box, tip[None])
    height = triangles.corners[:, :, 1].mean(axis=1)
    assert triangles.colour[height > 0.3].mean() > triangles.colour[height < -0.3].mean() + 0.05
    assert triangles.colour.min() >= 0 and triangles.colour.max() <= 1


def test_a_surface_seen_from_its_edge_draws_nothing_and_does_not_fail():
    flat = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 0, 1]], [[0, 1, 2]], process=False)
    assert len(lit_triangles(cut_small([flat], 1.0), HERE).colour) == 0
