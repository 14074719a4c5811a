"""Which clouds are typical."""

import torch

from articulate_ssl.discovery.references import choose_references


def test_references_are_typical_of_clusters_and_do_not_depend_on_orientation():
    generator = torch.Generator().manual_seed(0)
    ball = torch.nn.functional.normalize(torch.randn(20, 100, 3, generator=generator), dim=-1)
    size = torch.cat([torch.linspace(0.9, 1.1, 9), torch.linspace(1.9, 2.1, 9), torch.tensor([0.5, 3.0])])
    small, large = sorted(choose_references(ball * size[:, None, None], 2).tolist())
    assert small in (3, 4, 5) and large in (12, 13, 14)
    spheres = ball * size[:, None, None] * torch.tensor([1.0, 2.0, 3.0])
    turned = spheres @ torch.linalg.qr(torch.randn(20, 3, 3, generator=generator)).Q
    assert torch.equal(choose_references(spheres, 3), choose_references(turned, 3))
    assert choose_references(spheres, 1).shape == (1,)
