"""Partial clouds: protocols, visibility, noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from objects import box, box_laptop

from render.category import load_category
from render.partial_cloud import RENDERERS, DepthSensor
from render.posing import compose

STATE = np.array([1.5])


def sensor(instance=None, **changes) -> DepthSensor:
    settings = {
        "view": load_category("laptop").view,
        "renderer": "egl",
        "protocol": "honest",
        "resolution": 128,
        "num_points": 512,
        "min_visible_points": 100,
        "noise_std": 0.0,
    } | changes
    return DepthSensor(instance or box_laptop(), **settings)


def distances_to_surface(instance, cloud) -> np.ndarray:
    """Distance of every point to the posed mesh of its own part."""
    pose = compose(cloud.rotation, cloud.translation, instance.part_motion(STATE))
    distance = np.empty(len(cloud.points))
    for part, mesh in enumerate(instance.meshes):
        posed, mine = mesh.copy().apply_transform(pose[part]), cloud.part_id == part
        distance[mine] = trimesh.proximity.closest_point_naive(posed, cloud.points[mine])[1]
    return distance


@pytest.mark.parametrize("renderer", RENDERERS)
@pytest.mark.parametrize("protocol", ["honest", "eap"])
def test_points_lie_on_their_parts(renderer, protocol):
    laptop = box_laptop()
    cloud = sensor(renderer=renderer, protocol=protocol).observe(laptop.part_motion(STATE), np.random.default_rng(0))
    assert cloud.points.shape == (512, 3)
    assert distances_to_surface(laptop, cloud).max() < 1e-5


def test_both_renderers_see_the_same():
    clouds = [
        sensor(renderer=name).observe(box_laptop().part_motion(STATE), np.random.default_rng(0)) for name in RENDERERS
    ]
    np.testing.assert_allclose(clouds[0].points, clouds[1].points, atol=1e-5)


def test_honest_normalisation_uses_the_observed_points_alone():
    cloud = sensor().observe(box_laptop().part_motion(STATE), np.random.default_rng(0))
    points = (cloud.points - cloud.center) / cloud.scale
    np.testing.assert_allclose(points.mean(0), 0, atol=1e-12)
    assert np.linalg.norm(points, axis=1).mean() == pytest.approx(0.3)


def test_eap_normalisation_uses_the_complete_mesh():
    laptop = box_laptop()
    cloud = sensor(protocol="eap").observe(laptop.part_motion(STATE), np.random.default_rng(0))
    pose = compose(cloud.rotation, cloud.translation, laptop.part_motion(STATE))
    centroids = [mesh.copy().apply_transform(p).centroid for mesh, p in zip(laptop.meshes, pose, strict=True)]
    np.testing.assert_allclose(cloud.center, np.mean(centroids, axis=0), atol=1e-12)
    assert cloud.scale == laptop.rest_diagonal


def test_parts_hide_each_other_only_under_honest():
    """A lid behind a large plate: alone it is seen, in one scene it never is."""
    laptop = box_laptop()
    plate = box([-9, -9, 0.5], [9, 9, 0.6])
    hidden = replace(laptop, meshes=(plate, laptop.meshes[1]))
    front = replace(load_category("laptop").view, azimuth=(0, 0.1), elevation=(0, 0.1))
    with pytest.raises(ValueError, match="'box': none of 200 views shows 13 points of part 'lid'"):
        sensor(hidden, view=front, resolution=32, renderer="egl").observe(
            hidden.part_motion(STATE), np.random.default_rng(0)
        )
    alone = sensor(hidden, view=front, protocol="eap", min_visible_points=1, resolution=256)
    cloud = alone.observe(hidden.part_motion(STATE), np.random.default_rng(0))
    assert (cloud.part_id == 1).any()


def test_views_without_enough_of_a_part_are_rejected_and_counted():
    laptop = box_laptop()
    strict = sensor(min_visible_points=1900)
    clouds = [strict.observe(laptop.part_motion(STATE), np.random.default_rng(seed)) for seed in range(5)]
    assert sum(cloud.rejected_views for cloud in clouds) > 0
    assert min(np.bincount(cloud.part_id).min() for cloud in clouds) >= 1900 * 512 / 4096


def test_noise_moves_points_along_their_rays():
    laptop, std = box_laptop(), 0.01
    motion = laptop.part_motion(STATE)
    noisy = sensor(noise_std=std).observe(motion, np.random.default_rng(0))
    distance = distances_to_surface(laptop, noisy) / laptop.rest_diagonal
    assert 0.2 * std < np.sqrt((distance**2).mean()) < std


def test_small_images_are_rendered_finer_until_there_are_enough_pixels():
    laptop = box_laptop()
    cloud = sensor(resolution=16, num_points=2000).observe(laptop.part_motion(STATE), np.random.default_rng(0))
    assert len(np.unique(cloud.points, axis=0)) == 2000
    with pytest.raises(ValueError, match="fewer than 30000000 pixels"):
        sensor(num_points=30_000_000).observe(laptop.part_motion(STATE), np.random.default_rng(0))
