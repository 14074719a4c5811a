"""What a module remembers of the clouds it was trained on, for scans it will see later."""

from __future__ import annotations

import torch
from torch import Tensor, nn

_RADIUS_WEIGHT = 0.01  # of a batch, once a hundred are seen


class RadiusStatistics(nn.Module):
    """Of training clouds' mean distance to their centre: how a scan of unknown scale is scaled."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.tensor(0.0))
        self.register_buffer("square", torch.tensor(0.0))

    @property
    def spread(self) -> Tensor:
        """Standard deviation over the clouds."""
        return (self.square - self.mean.square()).clamp(min=0).sqrt()

    @torch.no_grad()
    def follow(
        self,
        points: Tensor,  # [B, N, 3]
        step: int,
    ) -> None:
        """Take a batch into account."""
        radius = (points - points.mean(dim=1, keepdim=True)).norm(dim=-1).mean(dim=1)
        weight = max(_RADIUS_WEIGHT, 1 / (step + 1))
        self.mean.lerp_(radius.mean(), weight)
        self.square.lerp_(radius.square().mean(), weight)
