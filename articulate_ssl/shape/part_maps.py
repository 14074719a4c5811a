"""One affine map per part: rigid where a part is posed, a stretch where an instance's part has other proportions."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class PartMaps:
    """x -> linear x + shift, for K parts of n shapes.

    Attributes:
        linear: [n, K, 3, 3].
        shift: [n, K, 3].
    """

    linear: Tensor
    shift: Tensor

    @staticmethod
    def of(
        pose: Tensor,  # [n, K, 4, 4]
    ) -> PartMaps:
        """Rigid motions."""
        return PartMaps(pose[..., :3, :3], pose[..., :3, 3])

    def then(
        self,
        pose: Tensor,  # [n, K, 4, 4]
    ) -> PartMaps:
        """These maps, followed by rigid motions."""
        rotation = pose[..., :3, :3]
        shift = (rotation @ self.shift[..., None]).squeeze(-1) + pose[..., :3, 3]
        return PartMaps(rotation @ self.linear, shift)

    def move(
        self,
        points: Tensor,  # [T, 3], or [n, T, 3]
        label: Tensor,  # [T]
    ) -> Tensor:  # [n, T, 3]
        """Points moved with their part."""
        # The gradient of index_select sums in a fixed order, that of indexing does not.
        linear, shift = self.linear.index_select(1, label), self.shift.index_select(1, label)
        return torch.einsum("ntij,tj->nti" if points.dim() == 2 else "ntij,ntj->nti", linear, points) + shift
