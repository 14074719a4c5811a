"""Stage 0: rotation permutes the rigid hypotheses and turns their poses."""

import pytest
import torch

from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.network.options import NetworkOptions
from articulate_ssl.network.rigid_alignment import RigidAlignment


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-4), (torch.float64, 1e-9)])
@pytest.mark.parametrize(("order", "directions"), [(12, False), (60, True)])
def test_hypotheses_are_equivariant(order, directions, dtype, tolerance):
    torch.manual_seed(0)
    group = rotation_group(order)
    sizes = NetworkOptions(
        group_order=order,
        dims=[4, 8],
        radii=[0.3, 0.5],
        num_neighbors=10,
        num_kernel_points=13,
        num_centers=[24, 16],
        head_dim=6,
        directions=directions,
    )
    network = RigidAlignment(sizes, 10)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.4)
    network.to(dtype)
    points, shift = torch.rand(2, 32, 3, dtype=dtype), torch.tensor([1.0, 2.0, -1.0], dtype=dtype)
    with torch.no_grad():
        before = network(points).posed()
        assert before.std(dim=1).min() > 1e-3
        for a in range(len(group)):
            rotation = group.elements[a].to(dtype)
            after = network(points @ rotation.T + shift).posed()[:, group.product[a]]
            expected = before @ rotation.T + shift
            assert (after - expected).norm() / expected.norm() < tolerance
