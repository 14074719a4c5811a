"""Which part points of a cloud are of, as other clouds say that are like it."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from articulate_ssl.ops.chamfer import nearest_index


class Votes(NamedTuple):
    """Of B clouds.

    Attributes:
        points: [B, M, 3] that others were asked about.
        share: [B, M, K] of those who say that a point is of a part.
    """

    points: Tensor
    share: Tensor

    def at(
        self,
        points: Tensor,  # [B, N, 3] of the same clouds
    ) -> Tensor:  # [B, N, K]
        """What is said of the nearest points."""
        nearest = nearest_index(points.contiguous(), self.points.contiguous())
        return self.share.gather(1, nearest[..., None].expand(-1, -1, self.share.shape[2]))
