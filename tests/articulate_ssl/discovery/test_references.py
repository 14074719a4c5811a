"""Which clouds are typical."""

import torch

from articulate_ssl.discovery.references import choose_objects, choose_references


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


def test_objects_are_typical_in_the_mean_over_their_clouds_if_they_have_enough():
    generator = torch.Generator().manual_seed(0)
    size = torch.tensor([1.0, 1.1, 1.3, 1.7, 1.8, 2.0]).repeat_interleave(4)  # of six objects in four states each
    size = size + torch.tensor([0.4, -0.4, 0.4, -0.4]).repeat(6)  # which differ more than objects do
    ball = torch.nn.functional.normalize(torch.randn(24, 100, 3, generator=generator), dim=-1)
    shape = ball * size[:, None, None] * torch.tensor([1.0, 2.0, 3.0])
    instance = (10 * torch.arange(6)).repeat_interleave(4)
    chosen = choose_objects(shape, instance, 2, fewest=4).tolist()
    assert chosen[0] in (0, 10, 20) and chosen[1] in (30, 40, 50)
    turned = shape @ torch.linalg.qr(torch.randn(24, 3, 3, generator=generator)).Q
    assert choose_objects(turned, instance, 2, fewest=4).tolist() == chosen
    instance[0] = 99
    assert 0 not in choose_objects(shape, instance, 6, fewest=4).tolist()
    assert len(choose_objects(shape, instance, 6, fewest=4)) == 5
    assert len(choose_objects(shape, instance, 2, fewest=5)) == 0
