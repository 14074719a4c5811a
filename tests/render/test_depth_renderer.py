"""Rasterised depth and part ids against the ray caster, and both against plane geometry."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from objects import box

from render import depth_renderer
from render.camera import BACKGROUND, Camera, sample_view
from render.category import load_category
from render.depth_renderer import DepthRenderer, RendererUnavailable
from render.posing import compose, sample_states
from render.ray_caster import RayCaster
from render.sources import open_source

RENDERERS = pytest.mark.parametrize("renderer", [DepthRenderer, RayCaster])
CATEGORIES = ("laptop", "laptop_real", "oven", "safe", "washing_machine", "drawer", "eyeglasses", "desk_lamp")


def at_depth(depth: float) -> np.ndarray:  # [4, 4]
    pose = np.eye(4)
    pose[2, 3] = depth
    return pose


@RENDERERS
def test_depth_of_a_wall_is_exact_everywhere(renderer):
    wall = box([-9, -9, 0], [9, 9, 1])
    depth, part_id = renderer([wall]).render(np.array([at_depth(2.5)]), Camera(32))
    np.testing.assert_allclose(depth, 2.5, atol=2e-6)
    assert (part_id == 0).all()


@RENDERERS
def test_nearer_parts_hide_farther_ones_unless_drawn_alone(renderer):
    near, far = box([-0.2, -0.2, 0], [0.2, 0.2, 0.1]), box([-0.5, -0.5, 1], [0.5, 0.5, 1.1])
    caster, poses, camera = renderer([far, near]), np.array([at_depth(1.0)] * 2), Camera(33)
    depth, part_id = caster.render(poses, camera)
    assert (part_id[16, 16], part_id[16, 9], part_id[0, 0]) == (1, 0, BACKGROUND)
    assert depth[16, 16] == pytest.approx(1) and depth[16, 9] == pytest.approx(2) and depth[0, 0] == 0
    depth, part_id = caster.render(poses, camera, parts=[0])
    assert part_id[16, 16] == 0 and depth[16, 16] == pytest.approx(2)


@RENDERERS
@pytest.mark.parametrize("faces", [[[0, 1, 2]], [[2, 1, 0]]])
def test_open_surfaces_are_seen_from_both_sides(renderer, faces):
    sheet = trimesh.Trimesh([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], faces)
    _, part_id = renderer([sheet]).render(np.array([at_depth(3.0)]), Camera(32))
    assert (part_id == 0).sum() > 100


def test_bodies_that_are_inside_out_are_seen_from_outside():
    solid, inverted = box([-0.5, -0.5, -0.5], [0, 0.5, 0.5]), box([0.01, -0.5, -0.5], [0.5, 0.5, 0.5])
    inverted.invert()
    mesh, poses = trimesh.util.concatenate([solid, inverted]), np.array([at_depth(3.0)])
    depth, _ = DepthRenderer([mesh]).render(poses, Camera(64))
    expected, _ = RayCaster([mesh]).render(poses, Camera(64))
    np.testing.assert_allclose(depth, expected, atol=1e-5)


def test_one_renderer_leaves_the_other_alone():
    """All share one context: another image size, or another object's end, changes nothing."""
    first, second = DepthRenderer([box([-0.5, -0.5, 0], [0.5, 0.5, 1])]), DepthRenderer([box([-9, -9, 0], [9, 9, 1])])
    pose = np.array([at_depth(2.0)])
    expected = first.render(pose, Camera(40))
    assert second.render(pose, Camera(24))[0].shape == (24, 24)
    del second
    for image, wanted in zip(first.render(pose, Camera(40)), expected, strict=True):
        np.testing.assert_array_equal(image, wanted)


def test_a_device_that_is_missing_is_a_clear_error(monkeypatch):
    monkeypatch.setenv("EGL_DEVICE_ID", "99")
    with pytest.raises(RendererUnavailable, match=r"no offscreen OpenGL .*Invalid device ID \(99"):
        depth_renderer.offscreen_context.__wrapped__()


def test_camera_inside_the_object_is_refused():
    with pytest.raises(ValueError, match="camera is inside the object"):
        DepthRenderer([box([-1, -1, -1], [1, 1, 1])]).render(np.array([at_depth(0.5)]), Camera(32))


@pytest.mark.parametrize("category", CATEGORIES)
def test_depth_agrees_with_the_ray_caster(category):
    """Median error at most 1e-5 of the scene size, at most 2 silhouette pixels off; worst seen: 2e-7 and 1."""
    spec = load_category(category)
    source = open_source("procedural", spec, None, 0)
    instance = spec.to_rest(source.load(source.instance_ids()[0]))
    renderer, caster, rng = DepthRenderer(instance.meshes), RayCaster(instance.meshes), np.random.default_rng(0)
    for states in sample_states(spec.sampled_ranges(instance), 3, rng):
        rotation, translation = sample_view(spec.view, np.zeros(3), 0.7 * instance.rest_diagonal, rng)
        pose = compose(rotation, translation, instance.part_motion(states))
        depth, part_id = renderer.render(pose, Camera(256))
        expected, expected_part = caster.render(pose, Camera(256))
        both = (depth > 0) & (expected > 0)
        assert both.sum() > 300
        assert ((depth > 0) != (expected > 0)).sum() <= 2
        assert np.median(abs(depth - expected)[both]) <= 1e-5 * instance.rest_diagonal
        assert (part_id != expected_part)[both].mean() < 2e-3
