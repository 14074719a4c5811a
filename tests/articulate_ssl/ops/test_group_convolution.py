"""The fast group convolution against its readable twin: values, gradients and equivariance."""

import pytest
import torch
from twins import TOLERANCE, assert_same_as_twin, relative_error

from articulate_ssl.geometry.equivariance import Permutation, Vector, assert_equivariant
from articulate_ssl.geometry.kernel_points import symmetric_kernel_points
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.ops import dense_group_convolution, reference
from articulate_ssl.ops.group_convolution import _TILE_ELEMENTS, group_convolution
from articulate_ssl.ops.neighborhood import build_neighborhood


def _problem(order=12, dtype=torch.float64, num_points=40, num_centers=20, channels=(5, 7), num_kernel_points=24):
    generator = torch.Generator().manual_seed(0)
    group = rotation_group(order)
    kernel = symmetric_kernel_points(group, num_kernel_points)
    points = 0.3 * torch.rand(2, num_points, 3, dtype=dtype, generator=generator)
    features = torch.randn(2, num_points, order, channels[0], dtype=dtype, generator=generator, requires_grad=True)
    weight = torch.randn(num_kernel_points, *channels, dtype=dtype, generator=generator, requires_grad=True)
    centers = torch.arange(num_centers).expand(2, -1)
    return group, kernel, points, features, weight, centers


def _assert_equal_to_reference(inputs, neighborhood, permutation, tolerance, features=None):
    arguments = (features, neighborhood, inputs[-1], permutation)
    assert_same_as_twin(
        lambda: group_convolution(*arguments), lambda: reference.group_convolution(*arguments), inputs, tolerance
    )


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("order", [12, 24, 60])
def test_values_and_gradients_equal_the_reference(order, dtype):
    _, kernel, points, features, weight, centers = _problem(order, dtype)
    neighborhood = build_neighborhood(points, 0.2, kernel.points, 16, centers)
    _assert_equal_to_reference((features, weight), neighborhood, kernel.permutation, TOLERANCE[dtype], features)


@pytest.mark.parametrize("budget", [1, 20 * 16 * 5 * 5, 20 * 16 * 5 * 12 * 2])
def test_the_tiling_does_not_change_the_result(monkeypatch, budget):
    monkeypatch.setitem(_TILE_ELEMENTS, "cpu", budget)
    _, kernel, points, features, weight, centers = _problem()
    neighborhood = build_neighborhood(points, 0.2, kernel.points, 16, centers)
    _assert_equal_to_reference((features, weight), neighborhood, kernel.permutation, 1e-9, features)


@pytest.mark.parametrize("budget", [1, 10**9])
@pytest.mark.parametrize("dtype", TOLERANCE)
def test_without_gathering_it_is_the_same(monkeypatch, dtype, budget):
    monkeypatch.setitem(dense_group_convolution._LEAST_GATHERED, "cpu", 0)
    monkeypatch.setitem(dense_group_convolution._BLOCK_ELEMENTS, "cpu", budget)
    _, kernel, points, features, weight, centers = _problem(60, dtype)
    points[:, 1] = points[:, 0]  # coincident
    neighborhood = build_neighborhood(points, 0.2, kernel.points, 16, centers)
    assert dense_group_convolution.is_faster_dense(features, neighborhood.weight)
    _assert_equal_to_reference((features, weight), neighborhood, kernel.permutation, TOLERANCE[dtype], features)


def test_many_points_are_gathered(monkeypatch):
    monkeypatch.setitem(dense_group_convolution._LEAST_GATHERED, "cpu", 0)
    few, many = torch.empty(1, 64, 12, 3), torch.empty(1, 2000, 12, 3)
    correlation = torch.empty(1, 64, 16, 24)
    assert dense_group_convolution.is_faster_dense(few, correlation)
    assert not dense_group_convolution.is_faster_dense(many, correlation)


def test_constant_input_equals_features_of_one():
    _, kernel, points, _, weight, centers = _problem(channels=(1, 7))
    neighborhood = build_neighborhood(points, 0.2, kernel.points, 16, centers)
    _assert_equal_to_reference((weight,), neighborhood, kernel.permutation, 1e-9)
    ones = torch.ones(2, 40, 12, 1, dtype=torch.float64)
    explicit = group_convolution(ones, neighborhood, weight, kernel.permutation)
    torch.testing.assert_close(group_convolution(None, neighborhood, weight, kernel.permutation), explicit)


@pytest.mark.parametrize(
    "points",
    [torch.zeros(1, 1, 3), torch.zeros(1, 6, 3), torch.eye(3)[None] * 10],
    ids=["one point", "coincident points", "no neighbours"],
)
def test_degenerate_clouds(points):
    kernel = symmetric_kernel_points(rotation_group(12))
    neighborhood = build_neighborhood(points.double(), 0.2, kernel.points, 4)
    features = torch.randn(1, points.shape[1], 12, 3, dtype=torch.float64, requires_grad=True)
    weight = torch.randn(24, 3, 4, dtype=torch.float64, requires_grad=True)
    _assert_equal_to_reference((features, weight), neighborhood, kernel.permutation, 1e-9, features)


def test_gradcheck():
    _, kernel, points, _, _, centers = _problem(num_points=5, num_centers=3)
    neighborhood = build_neighborhood(points, 0.3, kernel.points, 4, centers)
    features = torch.randn(2, 5, 12, 2, dtype=torch.float64, requires_grad=True)
    weight = torch.randn(24, 2, 1, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda f, w: group_convolution(f, neighborhood, w, kernel.permutation), (features, weight), fast_mode=True
    )


def test_non_contiguous_features_and_gradients():
    _, kernel, points, features, weight, centers = _problem()
    neighborhood = build_neighborhood(points, 0.2, kernel.points, 16, centers)
    strided = features.detach().transpose(2, 3).contiguous().transpose(2, 3).requires_grad_()
    _assert_equal_to_reference((strided, weight), neighborhood, kernel.permutation, 1e-9, strided)


def test_the_neighborhood_limits_what_a_centre_sees():
    _, kernel, points, features, weight, _ = _problem()
    neighborhood = build_neighborhood(points, 0.1, kernel.points, 40)
    out = group_convolution(features, neighborhood, weight, kernel.permutation)
    (gradient,) = torch.autograd.grad(out[:, 0].sum(), features)
    seen = gradient.abs().amax(dim=(2, 3)) > 0
    assert torch.equal(seen, (points - points[:, :1]).norm(dim=-1) <= 0.1)


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("order", [12, 24, 60])
def test_rotating_the_cloud_permutes_the_group(order, dtype):
    group, kernel, points, features, weight, centers = _problem(order, dtype)

    def layer(points, features):
        neighborhood = build_neighborhood(points, 0.2, kernel.points, 16, centers)
        return group_convolution(features, neighborhood, weight, kernel.permutation)

    with torch.no_grad():
        assert_equivariant(layer, (points, features), group, [Vector(), Permutation()], Permutation())


@pytest.mark.parametrize("broken", ["kernel", "permutation"])
def test_a_broken_layer_is_caught(broken):
    group, kernel, points, features, weight, centers = _problem(60)
    kernel_points, permutation = kernel
    if broken == "kernel":
        kernel_points = kernel_points + 0.05 * torch.randn_like(kernel_points)
    else:
        permutation = permutation[group.inverse]

    def layer(points, features):
        neighborhood = build_neighborhood(points, 0.2, kernel_points, 16, centers)
        return group_convolution(features, neighborhood, weight, permutation)

    with torch.no_grad(), pytest.raises(AssertionError, match="not equivariant"):
        assert_equivariant(layer, (points, features), group, [Vector(), Permutation()], Permutation())


def test_bfloat16_is_accurate_to_a_percent(monkeypatch):
    monkeypatch.setattr("articulate_ssl.ops.group_convolution.fast_dtype", lambda device: torch.bfloat16)
    _, kernel, points, features, weight, centers = _problem(60, torch.float32, channels=(16, 16))
    neighborhood = build_neighborhood(points, 0.2, kernel.points, 16, centers)
    exact = group_convolution(features, neighborhood, weight, kernel.permutation)
    with torch.autocast("cpu", torch.bfloat16):
        rounded = group_convolution(features, neighborhood, weight, kernel.permutation)
    assert rounded.dtype == torch.bfloat16
    gradients = [torch.autograd.grad(out, (features, weight), torch.ones_like(out)) for out in (exact, rounded)]
    assert relative_error(rounded.float(), exact) < 1e-2  # 4.6e-3 seen
    for a, b in zip(*gradients, strict=True):
        assert relative_error(b, a) < 1e-2
