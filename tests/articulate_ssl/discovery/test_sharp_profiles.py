"""Along the axes of its frame a cloud's points pile up."""

import math

import pytest
import roma
import torch
from articulated_objects import DRAWER, OVEN, clouds

from articulate_ssl.discovery.sharp_profiles import sharp_frame, sharpened, sharpness
from articulate_ssl.geometry.rotation_group import rotation_group

CUBE = rotation_group(24).elements.float()


def _off(degrees: float, count: int, seed: int = 0) -> torch.Tensor:
    axis = torch.nn.functional.normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(seed)), dim=-1)
    return roma.rotvec_to_rotmat(math.radians(degrees) * axis)


@pytest.mark.parametrize(("noise", "most"), [(0.0, 0.7), (0.005, 1.0)])
def test_frames_become_exact(noise, most):
    data = clouds(DRAWER, count=6, points=4096, resample=True, seed=2)
    generator = torch.Generator().manual_seed(0)
    noisy = data.points + noise * torch.randn(data.points.shape, generator=generator)
    rough = _off(4.0, 6) @ data.base[:, :3, :3].mT
    found = torch.stack([sharpened(*one, generator) for one in zip(noisy, rough, strict=True)])
    error = roma.rotmat_geodesic_distance(found @ data.base[:, :3, :3], torch.eye(3).expand(6, 3, 3)).rad2deg()
    assert error.max() < most
    assert (torch.linalg.det(found) > 0.999).all()


@pytest.mark.parametrize("design", [DRAWER, OVEN], ids=["drawer", "oven"])
def test_a_frame_that_is_turned_about_an_axis_is_found_again(design):
    """As normals leave it where most planes are parallel; one that is right stays."""
    data = clouds(design, count=4, points=4096, resample=True, seed=2)
    kept = (data.part == 0) | (torch.arange(4096) % 4 == 0)  # of what moves, a fourth: real doors are less of a cloud
    points, right = data.points[:, kept], data.base[:, :3, :3].mT
    wrong = roma.rotvec_to_rotmat(torch.tensor([[0.0, 0.7, 0], [0.4, 0, 0], [0, 0, -0.5], [0, 0.3, 0]])) @ right
    for rough, others in ((wrong, wrong), (right, wrong), (wrong, right)):
        every = zip(points, rough, others[:, None], strict=True)
        found = torch.stack([sharp_frame(*one) for one in every])
        seen = (found @ data.base[:, :3, :3])[:, None].expand(-1, 24, 3, 3)
        error = roma.rotmat_geodesic_distance(seen, CUBE.expand_as(seen)).amin(dim=1).rad2deg()
        assert error.max() < 0.7


def test_what_is_turned_is_less_sharp_and_what_is_moved_as_sharp():
    data = clouds(DRAWER, count=1, points=4096, rotate=False)
    cloud = data.points[0]
    turned = torch.stack([cloud @ _off(degrees, 1)[0].mT for degrees in (0.0, 1.0, 3.0, 9.0)])
    assert (sharpness(turned, 0.015).diff() < 0).all()
    moved = sharpness(cloud + torch.tensor([0.3, -0.7, 5.0]), 0.015)
    torch.testing.assert_close(moved, sharpness(cloud, 0.015), rtol=1e-3, atol=0)


def test_counts_are_those_of_a_histogram():
    """Where points are in the middle of cells, each counts in one."""
    cells = torch.randint(0, 9, (200, 3), generator=torch.Generator().manual_seed(0))
    cells[0] = 0
    expected = sum(float(torch.bincount(cells[:, axis]).square().sum()) for axis in range(3))
    assert float(sharpness(cells * 0.25, 0.25)) == expected
