"""Which joint states training clouds showed, and where a search for those of others starts."""

from __future__ import annotations

import torch
from torch import Tensor, nn

_RANGE_WEIGHT = 0.02  # of a batch
_SIDE = 1 / 3  # of the width of a joint's range, from its middle


class StateRange(nn.Module):
    """Running means of the lowest and of the highest joint state of each batch: narrower than all states seen.

    Attributes:
        limits: [J, 2].
    """

    def __init__(self, num_joints: int) -> None:
        super().__init__()
        self.register_buffer("limits", torch.zeros(num_joints, 2))

    def starts(self) -> Tensor:  # [1 + 2^J, J]
        """Where to start looking for joint states: the middle of the range, and in every combination either side."""
        low, high = self.limits.unbind(-1)
        middle, side = (low + high) / 2, _SIDE * (high - low)
        sides = torch.cartesian_prod(*torch.stack([middle - side, middle + side], dim=-1)).view(-1, len(middle))
        return torch.cat([middle[None], sides])

    @torch.no_grad()
    def follow(
        self,
        state: Tensor,  # [B, J]
    ) -> None:
        """Take a batch into account."""
        seen = torch.stack([state.amin(dim=0), state.amax(dim=0)], dim=-1)
        self.limits.lerp_(seen, _RANGE_WEIGHT if self.limits.any() else 1.0)
