"""Directions, and the orbits that kernels are constant on."""

import pytest
import torch

from articulate_ssl.geometry.directions import icosahedron_directions, kernel_orbits, kernel_rings
from articulate_ssl.geometry.kernel_points import symmetric_kernel_points
from articulate_ssl.geometry.rotation_group import rotation_group

GROUP = rotation_group(60)
DIRECTIONS = icosahedron_directions(GROUP)


def test_the_action_is_that_of_the_rotations():
    assert DIRECTIONS.vectors.norm(dim=-1) == pytest.approx(1)
    turned = torch.einsum("gij,vj->gvi", GROUP.elements, DIRECTIONS.vectors)
    torch.testing.assert_close(turned, DIRECTIONS.vectors[DIRECTIONS.action])
    stabiliser = (DIRECTIONS.action == torch.arange(12)).sum(dim=0)
    assert stabiliser.tolist() == [5] * 12


@pytest.mark.parametrize("num_points", [13, 24, 33])
def test_orbits_hold_what_the_group_maps_to_each_other_and_nothing_else(num_points):
    kernel = symmetric_kernel_points(GROUP, num_points)
    orbit, ring = kernel_orbits(DIRECTIONS, kernel), kernel_rings(DIRECTIONS, kernel)
    for action, permutation in zip(DIRECTIONS.action, kernel.permutation, strict=True):
        assert torch.equal(orbit[action][:, permutation][..., action], orbit)
        assert torch.equal(ring[action][:, permutation], ring)
    # Burnside's count; each of the 24 turns about 6 axes fixes the axis' two directions and the kernel points on it.
    fixed = (kernel.permutation[GROUP.nearest(_fifth_turn())] == torch.arange(num_points)).sum()
    assert orbit.unique().tolist() == list(range((12 * 12 * num_points + 24 * 2 * 2 * int(fixed)) // 60))
    assert ring.unique().tolist() == list(range((12 * num_points + 24 * 2 * int(fixed)) // 60))


def _fifth_turn():
    angle = torch.acos((GROUP.elements.diagonal(dim1=1, dim2=2).sum(dim=1) - 1) / 2)
    return GROUP.elements[(angle - 2 * torch.pi / 5).abs().argmin()]


def test_an_orbit_tells_mirror_images_apart():
    mirror = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    image = torch.cdist(DIRECTIONS.vectors * mirror, DIRECTIONS.vectors).argmin(dim=1)
    orbit = kernel_orbits(DIRECTIONS, symmetric_kernel_points(GROUP, 12))
    assert not torch.equal(orbit[image][:, image][..., image], orbit)


def test_other_groups_are_refused():
    with pytest.raises(ValueError, match="order 60, got order 12"):
        icosahedron_directions(rotation_group(12))
