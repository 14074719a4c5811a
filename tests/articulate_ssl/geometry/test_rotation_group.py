"""Group axioms of the rotation tables."""

import pytest
import roma
import torch

from articulate_ssl.geometry.rotation_group import rotation_group


@pytest.fixture(params=[12, 24, 60])
def group(request):
    return rotation_group(request.param)


def test_elements_are_distinct_rotations(group):
    elements = group.elements
    eye = torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(elements @ elements.transpose(1, 2), eye.expand_as(elements), rtol=0, atol=1e-15)
    torch.testing.assert_close(torch.linalg.det(elements), torch.ones(len(group), dtype=torch.float64))
    distance = (elements[:, None] - elements).flatten(2).norm(dim=-1)
    assert (distance + 10 * torch.eye(len(group))).min() > 0.5


def test_product_table_is_the_matrix_product(group):
    product = group.elements[:, None] @ group.elements
    torch.testing.assert_close(product, group.elements[group.product], rtol=0, atol=1e-15)


def test_identity_and_inverse(group):
    everything = torch.arange(len(group))
    assert group.identity == 0
    assert torch.equal(group.product[group.identity], everything)
    assert torch.equal(group.product[everything, group.inverse], torch.zeros_like(everything))


def test_product_is_associative(group):
    product = group.product
    a, b, c = torch.randint(len(group), (3, 1000))
    assert torch.equal(product[product[a, b], c], product[a, product[b, c]])


def test_larger_groups_contain_the_tetrahedral_group(group):
    distance = (rotation_group(12).elements[:, None] - group.elements).abs().amax(dim=(2, 3)).amin(dim=1)
    assert distance.max() < 1e-15


def test_nearest_is_the_smallest_angle(group):
    rotation = roma.random_rotmat(200).double()
    angle = roma.rotmat_geodesic_distance(rotation[:, None].expand(-1, len(group), -1, -1), group.elements[None])
    assert torch.equal(group.nearest(rotation), angle.argmin(dim=1))
    assert torch.equal(group.nearest(group.elements), torch.arange(len(group)))


def test_unknown_order_is_refused():
    with pytest.raises(ValueError, match="order of a rotation group"):
        rotation_group(59)
