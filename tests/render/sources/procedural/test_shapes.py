"""The solid-modelling helpers: sizes, places, orientation, and that their meshes are closed."""

import numpy as np
import pytest

from render.sources.procedural.shapes import (
    box,
    cylinder,
    extrude,
    loft,
    polygon,
    revolve,
    rounded_box,
    subtract,
    to_trimesh,
    union,
)


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_rounded_box_keeps_its_bounds_and_loses_only_corners_and_chamfers(axis):
    low, high = np.array([-1.0, 2.0, 0.5]), np.array([2.0, 4.0, 1.5])
    mesh = to_trimesh(rounded_box(low, high, axis, corner=0.2, edge=0.05))
    assert mesh.is_watertight
    np.testing.assert_allclose(mesh.bounds, [low, high], atol=1e-9)
    w = "xyz".index(axis)
    size = high - low
    area, outline = np.prod(np.delete(size, w)), 2 * np.delete(size, w).sum()
    corners = (4 - np.pi) * 0.2**2 * size[w]
    assert area * size[w] - corners - outline * 0.05**2 - 0.01 < mesh.volume < area * size[w] - 0.5 * corners


def test_rounded_box_without_corners_is_a_box():
    assert rounded_box((0, 0, 0), (1, 2, 3), "z", corner=0.0).volume() == pytest.approx(6.0)


def test_profiles_land_on_the_coordinates_that_extrude_promises():
    triangle = polygon([(0, 0), (3, 0), (0, 1)])
    extents = {axis: to_trimesh(extrude(triangle, axis, 5, 7)).bounds for axis in "xyz"}
    np.testing.assert_allclose(extents["x"], [[5, 0, 0], [7, 1, 3]])
    np.testing.assert_allclose(extents["y"], [[0, 5, 0], [3, 7, 1]])
    np.testing.assert_allclose(extents["z"], [[0, 0, 5], [3, 1, 7]])
    for axis in "xyz":
        assert to_trimesh(extrude(triangle, axis, 5, 7)).volume == pytest.approx(3.0)


def test_polygon_takes_either_winding():
    square = [(0, 0), (2, 0), (2, 2), (0, 2)]
    assert polygon(square).area() == polygon(square[::-1]).area() == pytest.approx(4.0)


def test_cylinder_and_cone_stand_where_they_are_told():
    mesh = to_trimesh(cylinder((1.0, 99.0, 3.0), "y", -1.0, 2.0, 0.5, 0.25, segments=200))
    np.testing.assert_allclose(mesh.bounds, [[0.5, -1.0, 2.5], [1.5, 2.0, 3.5]], atol=1e-3)
    assert mesh.volume == pytest.approx(np.pi * 3 / 3 * (0.25 + 0.125 + 0.0625), rel=1e-3)
    assert mesh.section([0, 1, 0], [0, 1.99, 0]).bounds[1, 0] < 1.26  # the narrow end is the upper one


def test_revolve_turns_a_profile_about_the_axis():
    ring = to_trimesh(revolve([(1.0, 0.0), (2.0, 0.0), (2.0, 0.5), (1.0, 0.5)], "z", segments=200))
    np.testing.assert_allclose(ring.bounds, [[-2, -2, 0], [2, 2, 0.5]], atol=1e-3)
    assert ring.volume == pytest.approx(np.pi * (4 - 1) * 0.5, rel=1e-3)
    assert ring.euler_number == 0


def test_loft_through_squares_is_a_closed_prism_facing_outwards():
    square = np.array([(-1.0, -1.0, 0.0), (1.0, -1.0, 0.0), (1.0, 1.0, 0.0), (-1.0, 1.0, 0.0)])
    mesh = to_trimesh(
        loft(np.stack([square + np.array([shift, 0, z]) for shift, z in ((0.0, 0.0), (0.5, 1.0), (0.0, 2.0))]))
    )
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(8.0)


def test_union_and_difference():
    pair = [box((0, 0, 0), (2, 1, 1)), box((1, 0, 0), (3, 1, 1))]
    assert union(pair).volume() == pytest.approx(3.0)
    assert subtract(pair[0], [pair[1], box((0, 0, 0), (0.5, 1, 1))]).volume() == pytest.approx(0.5)
