"""The backbone is equivariant, and treats every cloud and every order of points alike."""

import pytest
import torch

from articulate_ssl.geometry.directions import icosahedron_directions
from articulate_ssl.geometry.equivariance import TOLERANCE, Permutation, Vector, assert_equivariant, off_group_residual
from articulate_ssl.geometry.kernel_points import symmetric_kernel_points
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.network.backbone import DirectionConvolutionBlock, EquivariantBackbone, GroupConvolutionBlock
from articulate_ssl.ops.direction_convolution import direction_convolution
from articulate_ssl.ops.neighborhood import build_neighborhood


def _backbone(**options):
    torch.manual_seed(0)
    return EquivariantBackbone(
        **{"group_order": 12, "dims": (4, 6), "radii": (0.2, 0.3), "num_neighbors": 10} | options
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("separable", [False, True])
@pytest.mark.parametrize("intra", [False, True])
@pytest.mark.parametrize("group_order", [12, 24, 60])
def test_rotations_of_the_cloud_permute_the_group(group_order, intra, separable, dtype):
    backbone = _backbone(group_order=group_order, intra=intra, separable=separable, num_centers=(30, 20)).to(dtype)
    points = 0.5 * torch.rand(1, 40, 3, dtype=dtype)
    with torch.no_grad():
        assert_equivariant(backbone, (points,), backbone.group, [Vector()], Permutation())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rotations_of_the_cloud_permute_the_directions(dtype):
    backbone = _backbone(group_order=60, directions=True, num_kernel_points=13, num_centers=(30, 20)).to(dtype)
    points = 0.5 * torch.rand(1, 40, 3, dtype=dtype)
    action = icosahedron_directions(backbone.group).action
    with torch.no_grad():
        assert_equivariant(backbone, (points,), backbone.group, [Vector()], Permutation(action))
        # Pooled over the directions, features still tell a cloud from its mirror image.
        pooled = [backbone(p).mean(dim=2) for p in (points, points * torch.tensor([-1, 1, 1]))]
    assert _error(*pooled) > 1e-3


def _error(value, expected) -> float:
    return ((value - expected).norm() / expected.norm()).item()


def _with_places(backbone, points):
    """A broken layer: it reads where a point is, and in which place of the cloud."""
    return backbone(points) + points.mean(dim=-1)[..., None, None] * torch.linspace(0, 1, 40)[:, None, None]


CHEAPER = [{}, {"separable": True}, {"directions": True, "group_order": 60}]


@pytest.mark.parametrize("options", CHEAPER)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_translation_and_the_order_of_points_do_not_matter(dtype, options):
    backbone = _backbone(**options).to(dtype)
    points = 0.5 * torch.rand(2, 40, 3, dtype=dtype)
    order = torch.randperm(40)
    with torch.no_grad():
        expected = backbone(points)
        assert _error(backbone(points + 5), expected) < TOLERANCE[dtype]
        assert _error(backbone(points[:, order]), expected[:, order]) < TOLERANCE[dtype]
        expected = _with_places(backbone, points)
        assert _error(_with_places(backbone, points + 5), expected) > 1e-2
        assert _error(_with_places(backbone, points[:, order]), expected[:, order]) > 1e-2


@pytest.mark.parametrize("options", [{"intra": True}, *CHEAPER[1:]])
@pytest.mark.parametrize("training", [True, False])
def test_a_cloud_does_not_depend_on_the_rest_of_its_batch(training, options):
    backbone = _backbone(**options).double().train(training)
    points = 0.5 * torch.rand(3, 40, 3, dtype=torch.float64)
    alone = torch.cat([backbone(cloud[None]) for cloud in points])
    torch.testing.assert_close(backbone(points), alone, rtol=1e-12, atol=1e-12)


def test_centres_are_the_leading_points():
    backbone = _backbone(num_centers=(30, 20))
    points = 0.5 * torch.rand(2, 40, 3)
    assert backbone(points).shape == (2, 20, 12, 6)
    # The last layer's centres see the 30 points that the first kept.
    moved = points.clone()
    moved[:, 30:] += 10
    first = _backbone(num_centers=(30, 20))
    assert not torch.equal(first(moved), backbone(points))
    assert backbone(points[:, :15]).shape == (2, 15, 12, 6)


@pytest.mark.parametrize("options", [{"intra": True}, {"intra": True, "separable": True}, CHEAPER[2]])
def test_every_parameter_gets_a_gradient(options):
    backbone = _backbone(**options)
    backbone(0.5 * torch.rand(2, 40, 3)).square().sum().backward()
    for name, parameter in backbone.named_parameters():
        assert parameter.grad.abs().max() > 0, name


def test_a_separable_backbone_keeps_the_first_kernel_full():
    first, second = _backbone(separable=True).blocks
    assert first.weight.shape == (24, 1, 4)
    assert {n: p.shape for n, p in second.named_parameters(recurse=False)} == {"spatial": (24, 4), "mixing": (4, 6)}


def test_features_on_directions_need_the_icosahedral_group_and_no_convolution_over_it():
    with pytest.raises(ValueError, match="order 60"):
        _backbone(directions=True)
    with pytest.raises(ValueError, match="intra"):
        _backbone(directions=True, group_order=60, intra=True)


def test_a_layer_on_directions_starts_at_the_scale_of_a_full_one():
    torch.manual_seed(0)
    group = rotation_group(60)
    kernel = symmetric_kernel_points(group, 13)
    neighborhood = build_neighborhood(0.5 * torch.rand(1, 60, 3), 0.2, kernel.points, 16)
    block = DirectionConvolutionBlock(128, 256, icosahedron_directions(group), kernel)
    full = GroupConvolutionBlock(128, 256, group, kernel, False)
    with torch.no_grad():
        features = torch.randn(1, 60, 12, 128)
        out = direction_convolution(features, neighborhood, block.spatial, block.mixing, block.orbit)
        expected = full.convolve(torch.randn(1, 60, 60, 128), neighborhood)
    assert out.std() / expected.std() == pytest.approx(1, abs=0.2)


def test_a_separable_layer_starts_at_the_scale_of_a_full_one():
    torch.manual_seed(0)
    group = rotation_group(12)
    kernel = symmetric_kernel_points(group)
    neighborhood = build_neighborhood(0.5 * torch.rand(1, 60, 3), 0.2, kernel.points, 16)
    features = torch.randn(1, 60, 12, 128)
    full, separable = (GroupConvolutionBlock(128, 256, group, kernel, False, option) for option in (False, True))
    with torch.no_grad():
        ratio = separable.convolve(features, neighborhood).std() / full.convolve(features, neighborhood).std()
    assert ratio == pytest.approx(1, abs=0.1)


def test_layers_state_one_value_each():
    with pytest.raises(ValueError, match="one value per layer"):
        EquivariantBackbone(12, (4, 6), (0.2,))


def test_between_group_elements_the_residual_shrinks_with_the_group():
    points = 0.5 * torch.rand(4, 60, 3, dtype=torch.float64)
    residual = {
        order: off_group_residual(backbone, points, backbone.group)
        for order in (12, 60)
        for backbone in [_backbone(group_order=order).double().requires_grad_(False)]
    }
    assert 0 < residual[60] < residual[12]
