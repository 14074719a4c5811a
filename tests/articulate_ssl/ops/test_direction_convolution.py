"""The fast direction convolution against its readable twin: values, gradients and equivariance."""

import pytest
import torch
from twins import TOLERANCE, assert_same_as_twin, relative_error

from articulate_ssl.geometry.directions import icosahedron_directions, kernel_orbits, kernel_rings
from articulate_ssl.geometry.equivariance import Permutation, Vector, assert_equivariant
from articulate_ssl.geometry.kernel_points import symmetric_kernel_points
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.ops import reference
from articulate_ssl.ops.direction_convolution import (
    _CHANNELS,
    _TILE_ELEMENTS,
    constant_direction_convolution,
    direction_convolution,
)
from articulate_ssl.ops.neighborhood import build_neighborhood

GROUP = rotation_group(60)
DIRECTIONS = icosahedron_directions(GROUP)


def _problem(kernel_size=13, dtype=torch.float64, num_points=40, num_centers=20, channels=(5, 7)):
    generator = torch.Generator().manual_seed(0)
    kernel = symmetric_kernel_points(GROUP, kernel_size)
    orbit = kernel_orbits(DIRECTIONS, kernel)
    points = 0.3 * torch.rand(2, num_points, 3, dtype=dtype, generator=generator)
    inputs = [
        torch.randn(*shape, dtype=dtype, generator=generator, requires_grad=True)
        for shape in ((2, num_points, 12, channels[0]), (int(orbit.max()) + 1, channels[0]), channels)
    ]
    return kernel, orbit, points, inputs, torch.arange(num_centers).expand(2, -1)


def _assert_equal_to_reference(inputs, neighborhood, orbit, tolerance):
    features, spatial, mixing = inputs
    arguments = (features, neighborhood, spatial, mixing, orbit)
    assert_same_as_twin(
        lambda: direction_convolution(*arguments),
        lambda: reference.direction_convolution(*arguments),
        inputs,
        tolerance,
    )


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("kernel_size", [13, 24])
def test_values_and_gradients_equal_the_reference(kernel_size, dtype):
    kernel, orbit, points, inputs, centers = _problem(kernel_size, dtype)
    neighborhood = build_neighborhood(points, 0.2, kernel.points, 16, centers)
    _assert_equal_to_reference(inputs, neighborhood, orbit, TOLERANCE[dtype])


@pytest.mark.parametrize(("channels", "budget"), [(1, 1), (2, 1000), (5, 10**6)])
def test_the_tiling_does_not_change_the_result(monkeypatch, channels, budget):
    monkeypatch.setitem(_CHANNELS, "cpu", channels)
    monkeypatch.setitem(_TILE_ELEMENTS, "cpu", budget)
    kernel, orbit, points, inputs, centers = _problem()
    neighborhood = build_neighborhood(points, 0.2, kernel.points, 16, centers)
    _assert_equal_to_reference(inputs, neighborhood, orbit, 1e-9)


@pytest.mark.parametrize(
    "points",
    [torch.zeros(1, 1, 3), torch.zeros(1, 6, 3), torch.eye(3)[None] * 10],
    ids=["one point", "coincident points", "no neighbours"],
)
def test_degenerate_clouds(points):
    kernel, orbit, _, inputs, _ = _problem(num_points=points.shape[1])
    neighborhood = build_neighborhood(points.double(), 0.2, kernel.points, 4)
    inputs[0] = inputs[0].detach()[:1].requires_grad_()
    _assert_equal_to_reference(inputs, neighborhood, orbit, 1e-9)


def test_points_that_no_centre_sees_get_no_gradient():
    kernel, orbit, points, inputs, centers = _problem(num_centers=2)
    neighborhood = build_neighborhood(points, 0.2, kernel.points, 4, centers)
    assert len(neighborhood.index[0].unique()) < 10
    _assert_equal_to_reference(inputs, neighborhood, orbit, 1e-9)


def test_non_contiguous_features():
    kernel, orbit, points, (features, *weights), centers = _problem()
    neighborhood = build_neighborhood(points, 0.2, kernel.points, 16, centers)
    strided = features.detach().transpose(2, 3).contiguous().transpose(2, 3).requires_grad_()
    _assert_equal_to_reference((strided, *weights), neighborhood, orbit, 1e-9)


def test_gradcheck():
    kernel, orbit, points, inputs, centers = _problem(num_points=5, num_centers=3, channels=(2, 3))
    neighborhood = build_neighborhood(points, 0.3, kernel.points, 4, centers)
    assert torch.autograd.gradcheck(
        lambda f, s, m: direction_convolution(f, neighborhood, s, m, orbit), inputs, fast_mode=True
    )


def test_the_constant_input_is_the_feature_one():
    kernel, orbit, points, (_, spatial, mixing), centers = _problem(channels=(1, 7))
    neighborhood = build_neighborhood(points, 0.2, kernel.points, 16, centers)
    ones = points.new_ones(2, 40, 12, 1)
    # The kernel that a constant input sees: its sum over the neighbours' directions.
    ring = kernel_rings(DIRECTIONS, kernel)
    summed = spatial[orbit, 0].sum(dim=-1)
    weight = torch.stack([summed[ring == r][0] for r in range(int(ring.max()) + 1)])[:, None] * mixing
    out = constant_direction_convolution(neighborhood, weight, ring)
    assert relative_error(out, direction_convolution(ones, neighborhood, spatial, mixing, orbit)) < 1e-12


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("kernel_size", [13, 24])
def test_rotating_the_cloud_permutes_the_directions(kernel_size, dtype):
    kernel, orbit, points, (features, spatial, mixing), centers = _problem(kernel_size, dtype)

    def layer(points, features):
        neighborhood = build_neighborhood(points, 0.2, kernel.points, 16, centers)
        return direction_convolution(features, neighborhood, spatial, mixing, orbit)

    action = Permutation(DIRECTIONS.action)
    with torch.no_grad():
        assert_equivariant(layer, (points, features), GROUP, [Vector(), action], action)


def test_a_kernel_that_differs_within_an_orbit_is_caught():
    kernel, orbit, points, (features, spatial, mixing), centers = _problem()
    orbit = orbit.clone()
    orbit[0, 1, 2] = (orbit[0, 1, 2] + 1) % len(spatial)

    def layer(points, features):
        neighborhood = build_neighborhood(points, 0.2, kernel.points, 16, centers)
        return direction_convolution(features, neighborhood, spatial, mixing, orbit)

    action = Permutation(DIRECTIONS.action)
    with torch.no_grad(), pytest.raises(AssertionError, match="not equivariant"):
        assert_equivariant(layer, (points, features), GROUP, [Vector(), action], action)


def test_bfloat16_is_accurate_to_a_percent(monkeypatch):
    monkeypatch.setattr("articulate_ssl.ops.direction_convolution.fast_dtype", lambda device: torch.bfloat16)
    kernel, orbit, points, inputs, centers = _problem(24, torch.float32, channels=(16, 16))
    features, spatial, mixing = inputs
    neighborhood = build_neighborhood(points, 0.2, kernel.points, 16, centers)
    exact = direction_convolution(features, neighborhood, spatial, mixing, orbit)
    with torch.autocast("cpu", torch.bfloat16):
        rounded = direction_convolution(features, neighborhood, spatial, mixing, orbit)
    assert rounded.dtype == torch.bfloat16
    gradients = [torch.autograd.grad(out, inputs, torch.ones_like(out)) for out in (exact, rounded)]
    assert relative_error(rounded.float(), exact) < 1e-2
    for a, b in zip(*gradients, strict=True):
        assert relative_error(b, a) < 1e-2
