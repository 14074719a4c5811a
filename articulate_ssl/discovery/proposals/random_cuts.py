"""Random parallel cuts, refined: points that move together end up together, wherever the cuts were."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from articulate_ssl.discovery.proposals import Scene, Split

_EDGE = 0.1  # of the points, at either end, that no cut leaves alone


def propose(scene: Scene) -> list[Split]:
    """As many splits as the options say."""
    return [
        Split(random_split(scene.template, scene.num_parts, scene.generator), refined=True)
        for _ in range(scene.options.starts)
    ]


def random_split(template: Tensor, num_parts: int, generator: torch.Generator) -> Tensor:
    """[T] labels from K - 1 parallel cuts along a random direction, at random quantiles."""
    direction = functional.normalize(torch.randn(3, generator=generator), dim=0)
    height = template @ direction.to(template)
    cuts = (torch.rand(num_parts - 1, generator=generator) * (1 - 2 * _EDGE) + _EDGE).sort().values
    return torch.bucketize(height, torch.quantile(height, cuts.to(template)))


def cut_off(template: Tensor, height: Tensor, share: float, num_parts: int, generator: torch.Generator) -> Tensor:
    """[T] labels: part 0 is all but the highest share, which is cut at random into the others."""
    high = height > height.quantile(1 - share)
    label = torch.zeros(len(template), dtype=torch.long, device=template.device)
    label[high] = 1 if num_parts == 2 else 1 + random_split(template[high], num_parts - 1, generator)
    return label
