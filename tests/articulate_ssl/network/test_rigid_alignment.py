"""Stage 0: rotation permutes the rigid hypotheses and turns their poses."""

from dataclasses import replace

import pytest
import roma
import torch
from tiny import NETWORK

from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.network.rigid_alignment import RigidAlignment
from articulate_ssl.ops.chamfer import hypothesis_distances


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-4), (torch.float64, 1e-9)])
@pytest.mark.parametrize(("order", "directions"), [(12, False), (60, True)])
def test_hypotheses_are_equivariant(order, directions, dtype, tolerance):
    torch.manual_seed(0)
    group = rotation_group(order)
    sizes = replace(NETWORK, group_order=order, directions=directions)
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


def test_a_cloud_that_the_shape_started_from_is_found_wherever_it_is_turned_to():
    """By the group's rotations alone: nothing was trained."""
    torch.manual_seed(0)
    network = RigidAlignment(NETWORK, 48)
    cloud = torch.rand(64, 3) * torch.tensor([1.0, 0.6, 0.2])
    network.start_from(cloud)
    torch.testing.assert_close(network.template, cloud[:48] - cloud.mean(dim=0))
    for element in network.elements[[0, 5, 11]].float():
        turned = (cloud @ element.T)[None]
        with torch.no_grad():
            hypotheses = network(turned)
        best = hypothesis_distances(turned, hypotheses.posed()).argmin(dim=1)
        assert roma.rotmat_geodesic_distance(hypotheses.rotation[0, best[0]], element) < 0.1
    network.start_from(cloud[:30])  # of fewer points than the shape has
    torch.testing.assert_close(network.template[30:], network.template[:18])
