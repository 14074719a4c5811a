"""Registration recovers known poses from perturbed starts, every cloud on its own."""

import math

import pytest
import roma
import torch
from articulated_objects import DRAWER, GLASSES, LAPTOP, clouds, true_shape

from articulate_ssl.discovery.registration import (
    chamfer_l1,
    register_articulated,
    register_rigid,
    update_poses,
)
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.shape.articulated_shape import ArticulatedShape


def _jitter(count: int, degrees: float, shift: float, seed: int = 3) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    axis = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    return se3(roma.rotvec_to_rotmat(math.radians(degrees) * axis), shift * torch.randn(count, 3, generator=generator))


def _degrees(a, b):
    return roma.rotmat_geodesic_distance(a[..., :3, :3], b[..., :3, :3]).rad2deg().max().item()


@pytest.mark.parametrize("design", [LAPTOP, DRAWER, GLASSES], ids=["laptop", "drawer", "glasses"])
def test_known_poses_and_states_are_recovered_from_perturbed_starts(design):
    data = clouds(design)
    shape = true_shape(design, data)
    torch.testing.assert_close(shape.posed(data.base, data.state), data.points)
    reach = 0.15 if design is not DRAWER else 0.05
    start = data.base @ _jitter(len(data.base), 10, 0.02), data.state + reach
    base, state, error = register_articulated(shape, data.points, *start, (0.06, 0.01), 12)
    assert _degrees(base, data.base) < 2
    assert (state - data.state).abs().max() < 0.2 * reach
    assert error.max() < 0.02


def test_a_rigid_template_finds_every_orientation():
    data = clouds(LAPTOP, count=3)
    template = data.points[0]
    pose, error = register_rigid(
        template, data.points[:1] @ roma.random_rotmat(3).mT, rotation_group(60).elements.float(), keep=2
    )
    assert pose.shape == (3, 2, 4, 4) and error.shape == (3, 2)
    assert error[:, 0].max() < 0.02 and (error[:, 0] <= error[:, 1]).all()


def test_a_rod_keeps_its_roll():
    """Noise turns it about its length as easily as not; only what the points can tell may turn it."""
    generator = torch.Generator().manual_seed(0)
    rod = torch.randn(128, 3, generator=generator) * torch.tensor([0.3, 0.002, 0.002])
    turn = roma.rotvec_to_rotmat(torch.tensor([0.0, 0.0, 0.3]))
    moved = rod @ turn.T
    cloud = (moved + 0.004 * torch.randn(8, 128, 3, generator=generator)).contiguous()
    template = ArticulatedShape.rigid(rod)
    pose = torch.eye(4).expand(8, 1, 4, 4)
    for scale in (0.1, 0.05, 0.03, 0.02):
        pose = update_poses(template, pose, cloud, scale)
    assert _degrees(pose[:, 0], turn.expand(8, 3, 3)) < 3


def test_hidden_points_pull_at_nothing():
    """Of laptops cut in two more than half is seen: registered in both directions, all of it is drawn onto that."""
    data = clouds(LAPTOP)
    shape = true_shape(LAPTOP, data)
    seen = torch.stack([cloud[cloud[:, 0].argsort()[: 3 * len(cloud) // 5]] for cloud in data.points])
    start = data.base @ _jitter(len(data.base), 5, 0.02), data.state + 0.1
    base, state, _ = register_articulated(shape, seen, *start, (0.06, 0.01), 12, bidirectional=False)
    assert _degrees(base, data.base) < 0.5 and (state - data.state).abs().max() < 0.01
    base, state, _ = register_articulated(shape, seen, *start, (0.06, 0.01), 12)
    assert _degrees(base, data.base) > 20


def test_clouds_do_not_interact():
    data = clouds(GLASSES, count=4)
    shape = true_shape(GLASSES, data)
    start = data.base @ _jitter(4, 10, 0.02), data.state + 0.1
    together = register_articulated(shape, data.points, *start, (0.06, 0.02), 4)
    for i in range(4):
        one = slice(i, i + 1)
        alone = register_articulated(shape, data.points[one], start[0][one], start[1][one], (0.06, 0.02), 4)
        for a, b in zip(together, alone, strict=True):
            torch.testing.assert_close(a[one], b, rtol=1e-4, atol=1e-5)


def test_a_part_of_too_few_points_keeps_its_pose():
    data = clouds(LAPTOP, count=2)
    part = torch.zeros(128, dtype=torch.long)
    part[:3] = 1
    pose = _jitter(4, 5, 0.01).view(2, 2, 4, 4)
    moved = update_poses(ArticulatedShape.unjointed(data.rest, part, 2), pose, data.points, 0.05)
    assert torch.equal(moved[:, 1], pose[:, 1])
    assert not torch.equal(moved[:, 0], pose[:, 0])
    assert moved.isfinite().all()


def test_coincident_points_are_free_of_nan():
    template = ArticulatedShape.unjointed(torch.zeros(8, 3), torch.arange(8) % 2, 2)
    pose = torch.eye(4).expand(1, 2, 4, 4)
    assert update_poses(template, pose, torch.zeros(1, 9, 3), 0.05).isfinite().all()


def test_chamfer_is_the_mean_of_both_nearest_distances():
    a, b = torch.rand(2, 7, 3), torch.rand(2, 5, 3)
    distance = (a[:, :, None] - b[:, None]).norm(dim=-1)
    expected = distance.amin(dim=2).mean(dim=1) + distance.amin(dim=1).mean(dim=1)
    torch.testing.assert_close(chamfer_l1(a, b), expected, rtol=1e-4, atol=1e-4)
