"""Free space: what a view says about where nothing is, against rays that are walked one by one."""

import numpy as np
import pytest
import torch

from articulate_ssl.inference import free_space
from articulate_ssl.inference.free_space import FreeSpace
from articulate_ssl.ops.farthest_point import farthest_point_order


def _wall(random: np.random.Generator, half: float, depth: float, count: int = 1500) -> np.ndarray:
    """A square that faces the camera of a view, in farthest-point order."""
    points = np.c_[random.uniform(-half, half, (4 * count, 2)), np.full(4 * count, depth)]
    return points[farthest_point_order(points, count)]


@pytest.fixture
def wall():
    """Points of a view of a square of width 1 at z = 0, and what it says about free space."""
    points = torch.from_numpy(_wall(np.random.default_rng(0), 0.5, 0.0)).float()[None]
    return points, FreeSpace.of(points)


def test_the_camera_looks_along_z_from_where_it_sees_the_whole_object(wall):
    _, space = wall
    radius = 0.5 * 2**0.5
    expected = torch.tensor([[0.0, 0.0, -free_space._DISTANCE * radius]])
    torch.testing.assert_close(space.camera, expected, atol=0.05, rtol=0)


@pytest.mark.parametrize(
    "place, entered",
    [
        ((0.0, 0.0, 0.0), 0.0),  # as it was seen
        ((0.0, 0.0, 0.4), 0.0),  # behind it
        ((0.0, 0.0, -0.3), 0.3),  # before it
        ((0.9, 0.0, 0.0), 0.4),  # where no ray met anything
        ((0.9, 0.0, 0.3), 0.5),
        ((0.0, 0.0, -0.02), 0.0),  # as far before it as rays are apart
    ],
)
def test_what_is_before_or_beside_a_view_is_in_free_space_by_its_distance(wall, place, entered):
    """Of a small patch, none of which is hidden."""
    _, space = wall
    patch = torch.tensor(place) + 0.01 * torch.randn(1, 50, 3, generator=torch.Generator().manual_seed(0))
    assert float(space.entered(patch)[0]) == pytest.approx(entered, abs=0.04)


def test_what_is_hidden_does_not_count(wall):
    points, space = wall
    before, behind = points[:, :100] - torch.tensor([0, 0, 0.3]), points[:, :300] + torch.tensor([0, 0, 0.3])
    alone, both = space.entered(before), space.entered(torch.cat([before, behind], dim=1))
    assert float(alone[0]) > 0.2
    # Lines of sight to the border of what is behind pass beside the wall only where it is wider.
    inside = behind[:, (behind[0, :, :2].abs().amax(dim=1) < 0.5)]
    torch.testing.assert_close(space.entered(torch.cat([before, inside], dim=1)), both, atol=0.01, rtol=0)
    torch.testing.assert_close(both, alone, atol=0.01, rtol=0)


def test_as_rays_one_by_one_say(wall):
    points, space = wall
    random = np.random.default_rng(1)
    shape = random.uniform(-0.7, 0.7, (1, 200, 3))
    seen, camera = points[0].double().numpy(), space.camera[0].double().numpy()
    rays = (seen - camera) / np.linalg.norm(seen - camera, axis=1, keepdims=True)
    free, shown = 0.0, 0
    for point in shape[0]:
        depth = np.linalg.norm(point - camera)
        apart = np.linalg.norm((point - camera) / depth - rays, axis=1)
        ray = apart.argmin()
        reach = free_space._RAYS * float(space.step[0])
        before = np.linalg.norm(seen[ray] - camera) - depth
        met = apart[ray] <= reach
        if met and before < -reach * depth:
            continue
        shown += 1
        if not met or before > reach * depth:
            free += np.linalg.norm(point - seen, axis=1).min()
    found = space.entered(torch.from_numpy(shape).float())
    assert 0 < shown < 200 and float(found[0]) == pytest.approx(free / shown, rel=1e-3)


def test_views_are_asked_one_by_one_or_together_and_in_any_order(wall):
    points, _ = wall
    other = torch.from_numpy(_wall(np.random.default_rng(2), 0.3, 0.1)).float()[None]
    space = FreeSpace.of(torch.cat([points, other]))
    shape = torch.rand(2, 80, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    both = space.entered(shape)
    for i, cloud in enumerate((points, other)):
        torch.testing.assert_close(FreeSpace.of(cloud).entered(shape[i : i + 1])[0], both[i])
    order = torch.tensor([1, 0, 1])
    torch.testing.assert_close(space.rows(order).entered(shape[order]), both[order])


def test_a_shape_that_is_all_hidden_reaches_nowhere(wall):
    _, space = wall
    assert float(space.entered(torch.tensor([[[0.0, 0.0, 0.5], [0.1, 0.0, 0.4]]]))[0]) == 0
