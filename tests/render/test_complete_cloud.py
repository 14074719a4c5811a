"""Complete clouds: even, on the surface, and only where a sensor could reach."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from objects import box, box_laptop
from scipy.spatial import cKDTree

from render import complete_cloud
from render.category import load_category
from render.complete_cloud import ReachableSurface, _free, _OwnPart, fibonacci_sphere, move_parts, sample_surface
from render.posing import sample_states
from render.sources import open_source


def surface_of(instance, states=((1.0,),), pool_size=4000) -> ReachableSurface:
    return ReachableSurface(instance, np.array(states), np.random.default_rng(0), pool_size)


def with_base(mesh: trimesh.Trimesh):
    laptop = box_laptop()
    return replace(laptop, meshes=(mesh, laptop.meshes[1]))


def test_points_are_uniform_by_area():
    laptop = box_laptop()
    points, part_id = sample_surface(laptop, 20000, np.random.default_rng(0))
    expected = laptop.meshes[0].area / sum(mesh.area for mesh in laptop.meshes)
    assert (part_id == 0).mean() == pytest.approx(expected, abs=0.02)
    top = (part_id == 0) & (points[:, 1] > 0.02 - 1e-9)
    assert top.sum() / (part_id == 0).sum() == pytest.approx(0.3 * 0.2 / laptop.meshes[0].area, abs=0.02)


def test_inner_walls_and_buried_bodies_are_left_out():
    base = box_laptop().meshes[0]
    hidden = box([-0.1, 0.008, -0.05], [0.1, 0.012, 0.05])
    with_hidden = surface_of(with_base(trimesh.util.concatenate([base, hidden])))
    inside = (with_hidden.part_id == 0) & (abs(with_hidden.points[:, 1] - 0.01) < 0.005)
    inside &= (abs(with_hidden.points[:, [0, 2]]) < [0.12, 0.07]).all(1)
    assert not inside.any()


def test_surfaces_that_only_show_when_opened_are_kept():
    """Deep between closed base and lid nothing is seen; opened, both inner faces are."""

    def deep_points(states):
        points = surface_of(box_laptop(), states).points
        return ((abs(points[:, 1] - 0.0205) < 0.001) & (abs(points[:, 0]) < 0.07) & (abs(points[:, 2]) < 0.03)).sum()

    assert deep_points([[0.0]]) == 0
    assert deep_points([[0.0], [1.2]]) > 100


@pytest.mark.parametrize("category", ["drawer", "oven"])
def test_what_its_own_part_hides_is_hidden_in_every_state(category, monkeypatch):
    """Directions that a part blocks itself are left out, which must not change which points are reached."""
    spec = load_category(category)
    instance = spec.to_rest(open_source("procedural", spec, None, 0).load(f"{category}-0000"))
    states = sample_states(spec.sampled_ranges(instance), 4, np.random.default_rng(0))
    asked = []

    def counted(caster, points, direction, gap):
        asked.append(len(points))
        return _free(caster, points, direction, gap)

    monkeypatch.setattr(complete_cloud, "_free", counted)
    fast, rays = surface_of(instance, states), sum(asked)
    asked.clear()
    monkeypatch.setattr(_OwnPart, "leaves_open", lambda self, points, part_id: np.ones((64, len(points)), dtype=bool))
    np.testing.assert_array_equal(surface_of(instance, states).points, fast.points)
    assert rays < 0.9 * sum(asked)


def test_open_shells_are_seen_from_both_sides():
    sheet = trimesh.Trimesh(
        [[-0.15, 0, -0.1], [0.15, 0, -0.1], [0.15, 0, 0.1], [-0.15, 0, 0.1]], [[0, 1, 2], [0, 2, 3]]
    )
    assert (surface_of(with_base(sheet)).part_id == 0).any()


def test_cloud_lies_on_the_posed_surface_in_farthest_point_order():
    laptop = box_laptop()
    surface = surface_of(laptop, [[0.0], [1.0]])
    motion = laptop.part_motion(np.array([1.0]))
    points, part_id = surface.cloud(motion, 500, np.random.default_rng(1))
    for part, (mesh, matrix) in enumerate(zip(laptop.meshes, motion, strict=True)):
        posed = mesh.copy().apply_transform(matrix)
        _, distance, _ = trimesh.proximity.closest_point_naive(posed, points[part_id == part])
        assert distance.max() < 1e-6
    nearest = cKDTree(points[:100]).query(points[:100], k=2)[0][:, 1]
    assert nearest.min() > 0.02, "the first points are spread over the surface"
    another, _ = surface.cloud(motion, 500, np.random.default_rng(2))
    assert not np.array_equal(points, another), "every state gets its own sample"


def test_parts_that_no_sensor_reaches_are_refused():
    laptop = box_laptop()
    shell = trimesh.creation.box(extents=[2, 2, 2])
    enclosed = replace(laptop, meshes=(shell, laptop.meshes[1]))
    with pytest.raises(ValueError, match=r"'box'.*no sensor reaches part 'lid'"):
        surface_of(enclosed, [[0.5]])


def test_move_parts_moves_each_point_with_its_part():
    points, part_id = np.ones((4, 3)), np.array([0, 1, 1, 0])
    shift = np.eye(4)
    shift[:3, 3] = [1, 2, 3]
    np.testing.assert_array_equal(
        move_parts(points, part_id, np.stack([np.eye(4), shift])), [[1, 1, 1], [2, 3, 4], [2, 3, 4], [1, 1, 1]]
    )


def test_directions_are_even():
    directions = fibonacci_sphere(64)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    assert np.linalg.norm(directions.mean(0)) < 0.02
    assert cKDTree(directions).query(directions, k=2)[0][:, 1].min() > 0.2


def test_a_cloud_in_which_a_part_has_no_point_is_drawn_again():
    laptop = box_laptop()
    surface, still = surface_of(laptop), laptop.part_motion(np.array([1.0]))
    surface.part_id[:] = np.arange(len(surface.part_id)) % 20 == 0  # one point in twenty is of the lid
    for seed in range(20):
        assert set(surface.cloud(still, 12, np.random.default_rng(seed))[1]) == {0, 1}
    with pytest.raises(ValueError, match=r"'box': part '(base|lid)' has none of 1 points; pass more --points"):
        surface.cloud(still, 1, np.random.default_rng(0))
