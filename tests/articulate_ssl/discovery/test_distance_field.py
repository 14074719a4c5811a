"""Distances read off a grid are those to the cloud, to within a cell."""

import torch

from articulate_ssl.discovery.distance_field import HALF_WIDTH, DistanceFields


def test_distances_are_those_to_the_cloud():
    generator = torch.Generator().manual_seed(0)
    clouds = torch.rand(2, 50, 3, generator=generator) - 0.5
    query = 1.4 * torch.rand(300, 3, generator=generator) - 0.7
    fields = DistanceFields.of(clouds)
    for i in range(2):
        exact = torch.cdist(query, clouds[i]).amin(dim=1)
        # Both ends are off by up to half a cell's diagonal.
        assert (fields.at(i, query) - exact).abs().max() < 3**0.5 * 2 * HALF_WIDTH / 96
    assert fields.at(0, clouds[0]).max() == 0


def test_what_is_outside_is_far():
    """Also from a cloud at the face where it left."""
    fields = DistanceFields.of(torch.tensor([[[HALF_WIDTH - 0.01, 0, 0]]]))
    assert fields.at(0, torch.tensor([HALF_WIDTH - 0.01, 0, 0])) == 0
    assert fields.at(0, torch.tensor([HALF_WIDTH + 0.01, 0, 0])) == HALF_WIDTH
