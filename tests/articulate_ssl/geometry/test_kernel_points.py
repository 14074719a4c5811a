"""Kernel points are closed under their group."""

import pytest
import torch

from articulate_ssl.geometry.kernel_points import _ORBITS, symmetric_kernel_points
from articulate_ssl.geometry.rotation_group import rotation_group

CHOICES = [(order, count) for order, kernels in _ORBITS.items() for count in kernels]


@pytest.mark.parametrize("order,count", CHOICES)
def test_group_elements_permute_the_points(order, count):
    group = rotation_group(order)
    points, permutation = symmetric_kernel_points(group, count)
    assert points.shape == (count, 3)
    assert permutation.shape == (order, count)
    assert points.norm(dim=-1).max().item() == pytest.approx(1)
    rotated = torch.einsum("gij,kj->gki", group.elements, points)
    torch.testing.assert_close(rotated, points[permutation], rtol=0, atol=1e-15)
    assert torch.equal(permutation.sort(dim=1).values, torch.arange(count).expand(order, -1))


def test_points_are_apart():
    for order, count in CHOICES:
        points = symmetric_kernel_points(rotation_group(order), count).points
        distance = torch.cdist(points, points) + 10 * torch.eye(count)
        assert distance.min() > 0.4, (order, count)


def test_impossible_count_is_refused():
    with pytest.raises(ValueError, match="choose one of"):
        symmetric_kernel_points(rotation_group(60), 23)
