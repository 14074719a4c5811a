"""The fast group convolution against its readable twin: values, gradients and equivariance."""

import pytest
import torch

from articulate_ssl.groups import rotation_group
from articulate_ssl.ops import reference
from articulate_ssl.ops.group_convolution import group_convolution
from articulate_ssl.ops.kernel_points import symmetric_kernel_points
from articulate_ssl.ops.neighborhood import build_neighborhood

TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-9}


def _problem(order, dtype, num_points=40, num_centers=20, channels=(5, 7), seed=0):
    generator = torch.Generator().manual_seed(seed)
    group = rotation_group(order)
    kernel = symmetric_kernel_points(group)
    points = 0.3 * torch.rand(2, num_points, 3, dtype=dtype, generator=generator)
    features = torch.randn(2, num_points, order, channels[0], dtype=dtype, generator=generator, requires_grad=True)
    weight = torch.randn(len(kernel.points), *channels, dtype=dtype, generator=generator, requires_grad=True)
    centers = torch.arange(num_centers).expand(2, -1)
    return group, kernel, points, features, weight, centers


def _relative(a, b):
    return ((a - b).norm() / b.norm()).item()


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("order", [12, 24, 60])
def test_values_and_gradients_equal_the_reference(order, dtype):
    _, kernel, points, features, weight, centers = _problem(order, dtype)
    neighborhood = build_neighborhood(points, 0.2, kernel.points, 16, centers)
    fast = group_convolution(features, neighborhood, weight, kernel.permutation)
    slow = reference.group_convolution(features, neighborhood, weight, kernel.permutation)
    assert _relative(fast, slow) < TOLERANCE[dtype]
    direction = torch.randn_like(slow)
    for a, b in zip(
        torch.autograd.grad(fast, (features, weight), direction),
        torch.autograd.grad(slow, (features, weight), direction),
        strict=True,
    ):
        assert _relative(a, b) < TOLERANCE[dtype]
