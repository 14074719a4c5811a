"""Neighbourhoods and correlation weights against their definition."""

import pytest
import torch

from articulate_ssl.geometry.kernel_points import symmetric_kernel_points
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.ops.neighborhood import build_neighborhood, correlate, nearest_neighbors

KERNEL = symmetric_kernel_points(rotation_group(60)).points


@pytest.mark.parametrize("num_neighbors", [1, 5, 30, 64])
def test_weights_follow_their_definition(num_neighbors):
    points = torch.rand(2, 30, 3, dtype=torch.float64)
    centers = torch.randint(30, (2, 11))
    radius = 0.4
    neighborhood = build_neighborhood(points, radius, KERNEL, num_neighbors, centers)
    for b in range(2):
        for m in range(11):
            offset = points[b] - points[b, centers[b, m]]
            nearest = offset.norm(dim=-1).argsort()[:num_neighbors]
            nearest = nearest[offset[nearest].norm(dim=-1) <= radius]
            expected = torch.zeros(30, 24, dtype=torch.float64)
            square = (offset[nearest][:, None] - 0.7 * radius * KERNEL).square().sum(dim=-1)
            expected[nearest] = (1 - square / (0.5 * radius**2)).clamp(min=0) / len(nearest)
            actual = torch.zeros(30, 24, dtype=torch.float64)
            actual.index_add_(0, neighborhood.index[b, m], neighborhood.weight[b, m])
            torch.testing.assert_close(actual, expected, rtol=0, atol=1e-12)


def test_one_search_serves_every_radius():
    points = torch.rand(2, 40, 3)
    neighbors = nearest_neighbors(points, 16)
    for radius in (0.1, 0.5):
        shared = correlate(neighbors, radius, KERNEL)
        torch.testing.assert_close(shared, build_neighborhood(points, radius, KERNEL, 16))


@pytest.mark.parametrize("points", [torch.zeros(1, 1, 3), torch.zeros(2, 7, 3)], ids=["one point", "coincident"])
def test_degenerate_clouds_have_finite_weights(points):
    neighborhood = build_neighborhood(points, 0.2, KERNEL, 4)
    assert torch.isfinite(neighborhood.weight).all()
    # Every neighbour sits on the centre, so the weights are those of offset zero.
    expected = (1 - (0.7 * KERNEL).square().sum(dim=-1) / 0.5).clamp(min=0).float()
    torch.testing.assert_close(neighborhood.weight.sum(dim=2), expected.expand(*points.shape[:2], -1))


def test_a_lonely_point_sees_only_itself():
    points = torch.tensor([[[0.0, 0, 0], [10, 0, 0]]])
    neighborhood = build_neighborhood(points, 0.2, KERNEL, 2)
    seen = neighborhood.weight.amax(dim=-1) > 0  # [B, M, n]
    assert torch.equal(neighborhood.index[seen], torch.tensor([0, 1]))


def test_float32_weights_far_from_the_origin():
    points = torch.rand(1, 50, 3, dtype=torch.float64)
    exact = build_neighborhood(points, 0.3, KERNEL, 50)
    rounded = build_neighborhood((points + 10).float(), 0.3, KERNEL, 50)
    assert (exact.weight.sum(dim=2) - rounded.weight.sum(dim=2)).abs().max() < 1e-4


@pytest.mark.parametrize("count", [1, 16])
def test_a_tree_of_many_points_finds_what_all_distances_find(count):
    points = torch.rand(2, 1024, 3, dtype=torch.float64)
    points[1, :600] = points[1, 0]  # one place
    centers = torch.stack([torch.randperm(1024)[:256] for _ in points])
    neighbors = nearest_neighbors(points, count, centers)
    queries = points.gather(1, centers[..., None].expand(-1, -1, 3))
    nearest = torch.cdist(queries, points).topk(count, largest=False).values
    assert neighbors.index.shape == (2, 256, count)
    torch.testing.assert_close(neighbors.offset.norm(dim=1).sort().values, nearest, rtol=0, atol=1e-7)


def test_points_that_are_nowhere_are_no_reason_to_stop():
    points = torch.rand(1, 1024, 3)
    points[0, 3] = torch.nan
    assert torch.isfinite(nearest_neighbors(points, 4).offset[..., 4:, :]).all()


@pytest.mark.parametrize("shape", [(3, 3), (1, 0, 3), (1, 5, 2)])
def test_wrong_shapes_are_refused(shape):
    with pytest.raises(ValueError, match="points must be"):
        build_neighborhood(torch.zeros(shape), 0.1, KERNEL, 4)


def test_wrong_centers_are_refused():
    with pytest.raises(ValueError, match="centers must be"):
        build_neighborhood(torch.zeros(2, 5, 3), 0.1, KERNEL, 4, torch.arange(3))


def test_the_leading_centres_of_a_search_are_a_search_of_the_leading_centres():
    points = torch.rand(2, 30, 3, generator=torch.Generator().manual_seed(0))
    some = nearest_neighbors(points, 8, torch.arange(10).expand(2, -1))
    leading = nearest_neighbors(points, 8).leading(10)
    torch.testing.assert_close(leading.index.sort().values, some.index.sort().values)
    torch.testing.assert_close(leading.offset.sum(dim=-1), some.offset.sum(dim=-1))
