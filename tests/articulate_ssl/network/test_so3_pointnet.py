"""SO(3)-PointNet against its perceptron applied literally."""

import pytest
import torch

from articulate_ssl.geometry.directions import icosahedron_directions
from articulate_ssl.geometry.equivariance import Permutation, Vector, assert_equivariant
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.network.so3_pointnet import DirectionPointNet, SO3PointNet, largest_product


def _problem(order=12):
    torch.manual_seed(0)
    group = rotation_group(order)
    pointnet = SO3PointNet(5, 6, group.elements).double()
    features = torch.randn(2, 9, order, 5, dtype=torch.float64, requires_grad=True)
    points = torch.randn(2, 9, 3, dtype=torch.float64, requires_grad=True)
    association = torch.rand(2, 9, 2, dtype=torch.float64, requires_grad=True)
    return group, pointnet, features, points, association


def _literal(pointnet, features, points, association):
    local = torch.einsum("bmi,gij->bmgj", points, pointnet.elements)
    hidden = pointnet.perceptron(torch.cat([features, local], dim=-1))
    return (hidden[:, :, None] * association[..., None, None]).amax(dim=1)


def test_values_and_gradients_equal_the_literal_form():
    _, pointnet, *inputs = _problem()
    wanted = (*inputs, *pointnet.parameters())
    results = []
    for out in (pointnet(*inputs), _literal(pointnet, *inputs)):
        direction = torch.linspace(-1, 1, out.numel(), dtype=out.dtype).view_as(out)
        results.append((out, *torch.autograd.grad(out, wanted, direction)))
    for fast, slow in zip(*results, strict=True):
        torch.testing.assert_close(fast, slow, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("order", [12, 60])
def test_rotating_the_cloud_permutes_the_group(order):
    group, pointnet, features, points, association = _problem(order)
    with torch.no_grad():
        assert_equivariant(
            lambda f, p: pointnet(f, p, association),
            (features, points),
            group,
            [Permutation(), Vector()],
            Permutation(),
        )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_part_features_of_directions_are_functions_of_rotations(dtype):
    torch.manual_seed(0)
    group = rotation_group(60)
    directions = icosahedron_directions(group)
    pointnet = DirectionPointNet(5, 6, directions).to(dtype)
    features, points = torch.randn(2, 9, 12, 5, dtype=dtype), torch.randn(2, 9, 3, dtype=dtype)
    association = torch.rand(2, 9, 2, dtype=dtype)

    def pool(features, points):
        return pointnet(features, points, association)

    with torch.no_grad():
        out = pool(features, points)
        assert out.shape == (2, 2, 60, 6)
        # Directions have a stabiliser of five elements; what is read off all of them tells these apart.
        assert torch.cdist(out, out).add(10 * torch.eye(60)).min() > 1e-3
        inputs, actions = (features, points), [Permutation(directions.action), Vector()]
        assert_equivariant(pool, inputs, group, actions, Permutation())
        pointnet.order = pointnet.order.roll(1, 0)[:, group.inverse]
        with pytest.raises(AssertionError, match="not equivariant"):
            assert_equivariant(pool, inputs, group, actions, Permutation())


def test_a_point_of_association_zero_is_not_seen():
    _, pointnet, features, points, association = _problem()
    with torch.no_grad():
        association[:, 0] = 0
        before = pointnet(features, points, association)
        features[:, 0] += 10
        torch.testing.assert_close(pointnet(features, points, association), before)


def test_largest_product():
    features = torch.tensor([[[1.0, -4.0], [2.0, -3.0]]])
    weight = torch.tensor([[[1.0, 0.1], [1.0, 0.9]]])
    torch.testing.assert_close(largest_product(features, weight), torch.tensor([[[2.0, 0.0], [1.8, 0.0]]]))
