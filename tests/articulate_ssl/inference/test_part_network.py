"""Every point has a part, whatever else is in the batch and however the cloud is turned."""

import pytest
import roma
import torch

from articulate_ssl.inference.part_network import PartNetwork, looks


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return PartNetwork(3).double().eval()  # in float32 rounding exchanges neighbours that are as near


def _clouds(count: int, points: int, seed: int = 0) -> torch.Tensor:
    """Points on the faces of boxes, which are not quite plane: of a plane, rounding says which side is out."""
    generator = torch.Generator().manual_seed(seed)
    cloud = torch.rand(count, points, 3, generator=generator, dtype=torch.float64) - 0.5
    face = torch.arange(points) % 3
    cloud[:, torch.arange(points), face] = cloud[:, torch.arange(points), face].sign() / 2
    cloud = cloud + 0.005 * torch.randn(cloud.shape, generator=generator, dtype=torch.float64)
    return cloud * torch.tensor([1.0, 0.7, 0.5], dtype=torch.float64)


@pytest.mark.parametrize("points", [100, 700, 4500])
def test_every_point_has_parts(network, points):
    turn = torch.eye(3, dtype=torch.float64).expand(2, 2, 3, 3)
    found = network.probability(_clouds(2, points), turn)
    assert found.shape == (2, 2, points, 3)
    torch.testing.assert_close(found.sum(dim=-1), torch.ones(2, 2, points, dtype=torch.float64))


def test_what_counts_is_how_a_cloud_is_turned(network):
    clouds = _clouds(2, 1500)
    turn = roma.random_rotmat(4, dtype=torch.float64).view(2, 2, 3, 3)
    found = network.probability(clouds, turn)
    moved = roma.random_rotmat(2, dtype=torch.float64)
    again = network.probability(clouds @ moved.mT + 0.2, turn @ moved[:, None].mT)

    torch.testing.assert_close(again, found)
    assert (found[:, 0] - found[:, 1]).abs().max() > 1e-3


def test_clouds_do_not_interact(network):
    clouds, turn = _clouds(3, 1100), torch.eye(3, dtype=torch.float64).expand(3, 1, 3, 3)
    together, alone = network.probability(clouds, turn)[1:2], network.probability(clouds[1:2], turn[1:2])
    torch.testing.assert_close(together, alone)


@pytest.mark.parametrize(("count", "shares"), [(100, 1), (512, 1), (1023, 1), (1024, 2), (4096, 8)])
def test_looks_share_all_points(count, shares):
    found = [torch.arange(count)[one] for one in looks(count, 512)]
    assert len(found) == shares and sorted(torch.cat(found).tolist()) == list(range(count))
