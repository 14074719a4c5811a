"""On a GPU: fast operations equal their readable twins, and the CPU's answers. Skipped where there is none."""

from __future__ import annotations

import pytest
import torch
from tiny import POINTS, tiny_module
from twins import assert_same_as_twin, relative_error

from articulate_ssl.geometry.directions import icosahedron_directions, kernel_orbits
from articulate_ssl.geometry.equivariance import Permutation, Vector, assert_equivariant
from articulate_ssl.geometry.kernel_points import symmetric_kernel_points
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.network.backbone import EquivariantBackbone
from articulate_ssl.ops import dense_group_convolution, reference
from articulate_ssl.ops.chamfer import chamfer, hypothesis_distances, nearest_index
from articulate_ssl.ops.dense_group_convolution import is_faster_dense
from articulate_ssl.ops.direction_convolution import direction_convolution
from articulate_ssl.ops.group_convolution import group_convolution
from articulate_ssl.ops.neighborhood import build_neighborhood
from articulate_ssl.ops.separable_group_convolution import separable_group_convolution
from articulate_ssl.ops.spin_images import spin_images

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
GROUP = rotation_group(60)


@pytest.fixture(autouse=True, params=["highest", "high"])
def matmul_precision(request):
    """Whatever the rest of a program lets matrix products be rounded to, geometry is exact."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(request.param)
    yield request.param
    torch.set_float32_matmul_precision(before)


def _drawn(*shape, seed=0, requires_grad=False):
    drawn = torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return drawn.cuda().requires_grad_(requires_grad)


def _neighborhood(kernel):
    points = 0.2 * _drawn(2, 40, 3, seed=1)
    return build_neighborhood(points, 0.2, kernel.points, 16, torch.arange(20, device="cuda").expand(2, -1))


def test_at_the_papers_size_nothing_is_gathered_and_all_is_the_same(monkeypatch):
    kernel = symmetric_kernel_points(GROUP, 24)
    points = 0.15 * _drawn(2, 512, 3, seed=1)
    neighborhood = build_neighborhood(points.float(), 0.16, kernel.points, 64)
    features, weight = (_drawn(*shape).float().requires_grad_() for shape in ((2, 512, 60, 64), (24, 64, 32)))
    assert is_faster_dense(features, neighborhood.weight)
    results = []
    for gathers in (False, True):
        monkeypatch.setitem(dense_group_convolution._LEAST_GATHERED, "cuda", 2**62 if gathers else 0)
        for kind in (torch.float32, torch.bfloat16):
            with torch.autocast("cuda", torch.bfloat16, enabled=kind == torch.bfloat16):
                out = group_convolution(features, neighborhood, weight, kernel.permutation.cuda())
            assert out.dtype == kind
            results.append((out, *torch.autograd.grad(out, (features, weight), torch.ones_like(out))))
    exact = results[2]
    for found, tolerance in ((results[0], 2e-3), (results[1], 2e-2), (results[3], 2e-2)):
        assert all(relative_error(a.float(), b) < tolerance for a, b in zip(found, exact, strict=True))


@pytest.mark.parametrize("separable", [False, True])
def test_group_convolutions_equal_their_twins(separable):
    kernel = symmetric_kernel_points(GROUP, 24)
    neighborhood = _neighborhood(kernel)
    features = _drawn(2, 40, 60, 5, requires_grad=True)
    fast, twin = (
        (separable_group_convolution, reference.separable_group_convolution)
        if separable
        else (group_convolution, reference.group_convolution)
    )
    shapes = ((24, 5), (5, 7)) if separable else ((24, 5, 7),)
    weights = [_drawn(*shape, seed=2, requires_grad=True) for shape in shapes]
    permutation = kernel.permutation.cuda()
    arguments = (features, neighborhood, *weights, permutation)
    assert_same_as_twin(lambda: fast(*arguments), lambda: twin(*arguments), (features, *weights), 1e-9)


def test_the_direction_convolution_equals_its_twin():
    kernel = symmetric_kernel_points(GROUP, 13)
    orbit = kernel_orbits(icosahedron_directions(GROUP), kernel).cuda()
    inputs = [_drawn(*shape, requires_grad=True) for shape in ((2, 40, 12, 5), (int(orbit.max()) + 1, 5), (5, 7))]
    features, spatial, mixing = inputs
    arguments = (features, _neighborhood(kernel), spatial, mixing, orbit)
    assert_same_as_twin(
        lambda: direction_convolution(*arguments), lambda: reference.direction_convolution(*arguments), inputs, 1e-9
    )


def test_chamfer_equals_its_twin():
    clouds = _drawn(2, 3, 50, 3, requires_grad=True), _drawn(2, 3, 70, 3, seed=1, requires_grad=True)
    assert_same_as_twin(lambda: chamfer(*clouds), lambda: reference.chamfer(*clouds), clouds, 1e-9)


def test_distances_are_not_rounded():
    points, target = 0.3 * _drawn(4, 300, 3), 0.3 * _drawn(4, 400, 3, seed=1)
    index = nearest_index(points.float(), target.float())
    assert (index == torch.cdist(points, target).argmin(-1)).float().mean() > 0.998
    exact = hypothesis_distances(points, target[:, None] + torch.zeros(4, 5, 1, 1, device="cuda"))
    assert relative_error(hypothesis_distances(points.float(), target.float()[:, None]).double(), exact[:, :1]) < 1e-4


@pytest.mark.parametrize("options", [{}, {"separable": True}, {"directions": True, "num_kernel_points": 13}])
def test_the_backbone_is_that_of_the_cpu_and_equivariant(options, matmul_precision):
    torch.manual_seed(0)
    backbone = EquivariantBackbone(group_order=60, dims=(4, 6), radii=(0.2, 0.3), num_neighbors=10, **options)
    points = 0.2 * torch.randn(2, 60, 3, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        expected = backbone(points)
        found = backbone.cuda()(points.cuda())
    # Tensor cores that round to ten bits are for the network alone.
    assert relative_error(found.cpu(), expected) < (1e-4 if matmul_precision == "highest" else 2e-2)
    if matmul_precision == "highest":
        action = icosahedron_directions(GROUP).action if options.get("directions") else None
        double = backbone.double()
        with torch.no_grad():
            inputs = (points[:1, :40].double().cuda(),)
            permutation = Permutation() if action is None else Permutation(action.cuda())
            assert_equivariant(double, inputs, double.group, [Vector()], permutation)


def test_spin_images_are_those_of_the_cpu():
    points = torch.rand(1, 500, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([0.6, 0.5, 0.02])
    expected, _ = spin_images(points[:, :100], points)
    found, _ = spin_images(points[:, :100].cuda(), points.cuda())
    assert ((found.cpu() - expected).abs().amax(-1) < 0.02).float().mean() > 0.98


@torch.no_grad()
@pytest.mark.parametrize("recipe", ["paper", "staged"])
def test_replayed_proposals_are_those_of_the_first_time(recipe):
    module = tiny_module(recipe=recipe).eval().cuda()
    module.num_points = POINTS
    generator = torch.Generator().manual_seed(0)
    clouds = [torch.rand(1, POINTS, 3, generator=generator).cuda() for _ in range(4)]
    replayed = [module.predict_points(cloud, refine=False).part_pose for cloud in clouds]
    assert len(module.estimator._replay._recordings) == 1
    for cloud, pose in zip(clouds, replayed, strict=True):
        module.estimator._replay._asked = None
        module.estimator._replay._recordings.clear()
        torch.testing.assert_close(module.predict_points(cloud, refine=False).part_pose, pose, atol=1e-4, rtol=0)
