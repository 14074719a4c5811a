"""Explanations that were sought again, against those that were decided for: the nearer to its cloud wins."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from articulate_ssl.inference.candidates import ANOTHER_WAY, angle_to
from articulate_ssl.network.hypotheses import Hypotheses

# Of what training showed, the share of its error that another's has to be below: others explain a few open ovens by 4 %
# less (docs/experiments.md, step 274). Chosen there.
CLEARLY = 0.95


class Contest(NamedTuple):
    """Of B clouds.

    Attributes:
        one: What is decided for, in the clouds' proportions, H = 1.
        rival: H = 1, the best that is turned another way.
        margin: [B] how much worse the rival fits, at most.
        error: [B] distances of `one` from its clouds.
        as_rival: How an explanation is kept as a rival.
    """

    one: Hypotheses
    rival: Hypotheses
    margin: Tensor
    error: Tensor
    as_rival: Callable[[Hypotheses], Hypotheses] = lambda one: one

    def against(
        self,
        tried: Hypotheses,  # H = 1, in the clouds' proportions
        error: Tensor,  # [B]
        allowed: Tensor,  # [B] bool, which may win, or be rivals
        least: Tensor | float = 1.0,
    ) -> tuple[Contest, Tensor]:  # , rows
        """The better of each, and which clouds are explained otherwise than before.

        What gives way is a rival, if it is turned another way, and the margin how much worse it fits, at most.

        Args:
            least: [B] of what is decided for, its share that the other's error has to be below.
        """
        fits = allowed & (error < least * self.error)
        turned = allowed & (angle_to(self.one.base[..., :3, :3], tried.base[:, 0, :3, :3])[:, 0] > ANOTHER_WAY)
        beaten = 1 - self.error.minimum(error) / self.error.maximum(error)
        before = (turned & fits).nonzero()[:, 0]
        after = (turned & ~fits & (beaten < self.margin)).nonzero()[:, 0]
        rival = self.rival.with_rows(before, self.as_rival(self.one.rows(before)))
        rival = rival.with_rows(after, self.as_rival(tried.rows(after)))
        margin = torch.where(turned & (fits | (beaten < self.margin)), beaten, self.margin)
        rows = fits.nonzero()[:, 0]
        one, least_error = self.one.with_rows(rows, tried.rows(rows)), self.error.index_copy(0, rows, error[rows])
        return self._replace(one=one, rival=rival, margin=margin, error=least_error), rows
