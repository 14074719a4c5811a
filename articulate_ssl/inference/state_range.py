"""Which joint states training clouds showed: where a search for those of others starts, and what no joint does."""

from __future__ import annotations

import torch
from torch import Tensor, nn

_RANGE_WEIGHT = 0.02  # of a batch
_SIDE = 1 / 3  # of the width of a joint's range, from its middle
_SLACK = 0.05  # of the width of a joint's range, beyond it: some degrees, which predictions are off by. Chosen.


class StateRange(nn.Module):
    """Joint states of training clouds.

    Attributes:
        limits: [J, 2] running means of the lowest and of the highest of each batch: narrower than all states seen.
        seen: [J, 2] lowest and highest of what is predicted of training clouds in the end; equal until they are learnt.
        rest: [J] the state of a closed door, which any may be in whether training showed it or not.
        rests: [] whether it is known.
    """

    def __init__(self, num_joints: int) -> None:
        super().__init__()
        self.register_buffer("limits", torch.zeros(num_joints, 2))
        self.register_buffer("seen", torch.zeros(num_joints, 2))
        self.register_buffer("rest", torch.zeros(num_joints))
        self.register_buffer("rests", torch.tensor(False))

    def _load_from_state_dict(self, state_dict: dict, prefix: str, *rest) -> None:
        # Weights from before they were learnt.
        state_dict.setdefault(f"{prefix}seen", torch.zeros_like(self.seen))
        state_dict.setdefault(f"{prefix}rest", torch.zeros_like(self.rest))
        state_dict.setdefault(f"{prefix}rests", torch.zeros_like(self.rests))
        super()._load_from_state_dict(state_dict, prefix, *rest)

    @property
    def learnt(self) -> bool:
        """Whether it is known what is predicted in the end."""
        return bool((self.seen[:, 1] > self.seen[:, 0]).all())

    @property
    def known(self) -> Tensor:  # [J, 2]
        """Lowest and highest state, as well as they are known."""
        return self.seen if self.learnt else self.limits

    @property
    def possible(self) -> Tensor:  # [J, 2]
        """What is known, and on to a closed door."""
        if not self.rests:
            return self.known
        low, high = self.known.unbind(-1)
        return torch.stack([low.minimum(self.rest), high.maximum(self.rest)], dim=-1)

    def forget(self) -> None:
        """As before they were learnt."""
        self.seen.zero_()
        self.rests.fill_(False)

    def set_rest(self, state: float) -> None:
        """Take over at which state a door is closed."""
        self.rest.fill_(state)
        self.rests.fill_(True)

    def learn(
        self,
        state: Tensor,  # [n, J] of predictions of training clouds, of which some may be wrong
        width: float,
    ) -> None:
        """Take over which states there are: of each joint the range of that width in which most are.

        What is explained wrongly, each object in the same way, may be beyond it in many clouds: an oven's door that is
        taken for its bottom's is open by as much more as its own is by less.
        """
        for joint, own in enumerate(state.T):
            inside = ((own >= own[:, None]) & (own <= own[:, None] + width)).sum(dim=1)
            low = own[inside == inside.max()].mean()
            self.seen[joint] = torch.stack([low, low + width])

    def contains(
        self,
        state: Tensor,  # [..., J]
        slack: float = _SLACK,
    ) -> Tensor:  # [...] bool
        """Whether all joints are within what is possible, or about; everything, until it is known.

        Args:
            slack: How far beyond it counts, of the width of a joint's range as seen.
        """
        return self._within(self.possible, state, slack)

    def showed(
        self,
        state: Tensor,  # [..., J]
        slack: float = _SLACK,
    ) -> Tensor:  # [...] bool
        """Whether training clouds showed it, or about; everything, until it is known. `slack` as of `contains`."""
        return self._within(self.seen, state, slack)

    def _within(self, limits: Tensor, state: Tensor, slack: float) -> Tensor:
        if not self.learnt:
            return torch.ones_like(state[..., 0], dtype=torch.bool)
        more = slack * (self.seen[:, 1] - self.seen[:, 0])
        return ((state >= limits[:, 0] - more) & (state <= limits[:, 1] + more)).all(dim=-1)

    def starts(self) -> Tensor:  # [1 + 2^J, J]
        """Where to start looking for joint states: the middle of the range, and in every combination either side."""
        low, high = self.known.unbind(-1)
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
