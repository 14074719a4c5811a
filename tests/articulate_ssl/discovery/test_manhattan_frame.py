"""Boxes have a Manhattan frame, up to the rotations of the cube; balls have none."""

import pytest
import roma
import torch
from articulated_objects import DRAWER, OVEN, clouds

from articulate_ssl.discovery import manhattan_frame
from articulate_ssl.discovery.manhattan_frame import manhattan_frames, surface_normals
from articulate_ssl.geometry.rotation_group import rotation_group


def _generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.mark.parametrize("design", [DRAWER, OVEN], ids=["drawer", "oven"])
def test_the_frame_of_boxes_is_found_up_to_the_cube(design):
    data = clouds(design, count=6, points=4096, resample=True, seed=2)
    rotation, angle = manhattan_frames(data.points, _generator())
    cube = rotation_group(24).elements.float()
    seen = (rotation @ data.base[:, :3, :3])[:, None].expand(-1, 24, 3, 3)
    error = roma.rotmat_geodesic_distance(seen, cube.expand_as(seen)).amin(dim=1).rad2deg()
    # An oven's open door stands at another angle than its body.
    assert error.max() < 2
    assert (torch.linalg.det(rotation) > 0.99).all()
    if design is DRAWER:
        assert angle.max() < 1


@pytest.mark.parametrize("noise", [0.005, 0.01, 0.02])
def test_noise_leaves_frames_of_wider_windows(noise):
    data = clouds(DRAWER, count=6, points=4096, resample=True, seed=2)
    noisy = data.points + noise * torch.randn(data.points.shape, generator=_generator())
    rotation, angle = manhattan_frames(noisy, _generator())
    cube = rotation_group(24).elements.float()
    seen = (rotation @ data.base[:, :3, :3])[:, None].expand(-1, 24, 3, 3)
    error = roma.rotmat_geodesic_distance(seen, cube.expand_as(seen)).amin(dim=1).rad2deg()
    assert error.max() < 6 and angle.max() < 10


def test_normals_are_those_of_planes_and_edges_have_none():
    plane = torch.rand(1, 2000, 3, generator=_generator()) * torch.tensor([1.0, 1.0, 0.0])
    normals, planar = surface_normals(plane)
    assert planar.all() and (normals[..., 2].abs() > 0.999).all()
    solid = torch.rand(1, 2000, 3, generator=_generator())
    assert surface_normals(solid)[1].mean() < 0.05


def test_where_no_window_sees_planes_enough_the_one_that_sees_most_counts(monkeypatch):
    """Of a noisy plane few neighbours are never flat, and many are."""
    plane = torch.rand(1, 4000, 3, generator=_generator()) * torch.tensor([1.0, 1.0, 0.0])
    plane[..., 2] = 0.01 * torch.randn(4000, generator=_generator())
    monkeypatch.setattr(manhattan_frame, "_ENOUGH", 1.1)
    normals, planar = surface_normals(plane)
    assert planar.mean() > 0.9
    assert normals[planar.bool()][:, 2].abs().min() > 0.9


def test_a_frame_is_not_made_of_a_few_planes():
    sparse = clouds(DRAWER, count=3, points=256, resample=True)
    assert (surface_normals(sparse.points)[1].sum(dim=1) < 20).all()
    assert (manhattan_frames(sparse.points, _generator())[1] == 10).all()


def test_what_has_no_frame_says_so():
    ball = torch.nn.functional.normalize(torch.randn(2, 4096, 3, generator=_generator()), dim=-1)
    assert manhattan_frames(ball, _generator())[1].min() > 4


def test_what_is_found_of_a_whole_cloud_does_not_depend_on_others():
    data = clouds(OVEN, count=3, points=2048, resample=True, seed=2)
    every, _ = manhattan_frames(data.points, _generator(), whole=True)
    last, _ = manhattan_frames(data.points[2:], _generator(), whole=True)
    torch.testing.assert_close(last, every[2:])
