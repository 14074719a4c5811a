"""Distances to a cloud as a table over a grid, for the many thousand comparisons of a choice among all pairs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

HALF_WIDTH = 0.75  # of the cube that the grid fills; clouds lie within 0.5 or little more
_CELLS = 96  # along every edge: 0.016 wide


class DistanceFields(NamedTuple):
    """Of n clouds, the distance of every cell's centre to the nearest cell that holds a point.

    Attributes:
        values: [n, cells ** 3] float32.
    """

    values: Tensor

    @staticmethod
    def of(
        clouds: Tensor,  # [n, N, 3] within the cube
    ) -> DistanceFields:
        """Measure them."""
        fields = []
        for cell in _cells(clouds).cpu().numpy():
            free = np.ones(_CELLS**3, dtype=bool)
            free[cell] = False
            fields.append(distance_transform_edt(free.reshape(_CELLS, _CELLS, _CELLS)).astype(np.float32).ravel())
        return DistanceFields(torch.as_tensor(np.stack(fields)) * (2 * HALF_WIDTH / _CELLS))

    def at(self, index: int, points: Tensor) -> Tensor:
        """Distances of points [..., 3] to one of the clouds, [...]; outside the cube, every cloud is far."""
        outside = points.abs().amax(dim=-1) > HALF_WIDTH
        return self.values[index][_cells(points)].masked_fill(outside, HALF_WIDTH)


def _cells(points: Tensor) -> Tensor:
    place = ((points + HALF_WIDTH) * (_CELLS / (2 * HALF_WIDTH))).long().clamp(0, _CELLS - 1)
    return (place[..., 0] * _CELLS + place[..., 1]) * _CELLS + place[..., 2]
