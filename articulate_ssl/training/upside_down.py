"""Which doors are upside down, where as many are as are not: what a collection says of itself, without a label.

What stands on a door, a lock above a handle, is the other way up on one that is upside down. Which way a single door
is cannot be told, but all that tell it tell it the same way. So how far what is in a grid's cells stands out above the
middle, less how far it does as far below, are two Gaussians opposite each other, as reliefs are of two explanations
(`inference.two_ways`).
"""

from __future__ import annotations

import torch
from torch import Tensor

from articulate_ssl.inference.hinge_sides import Bodies
from articulate_ssl.inference.two_ways import decision_direction, scaled_and_capped

# Along the hinge and away from it. Of 2,000 doors of safes, half of them upside down, .85 are told by 6 x 4, .76 by
# 4 x 3, .84 by 12 x 6, all of them training clouds (docs/experiments.md, step 269).
_CELLS = 6, 4
_EDGE = 0.01  # share of the points beyond either end of the grid
_OUTLYING = 0.05  # normalised units before or behind the door's middle, beyond which a point counts as this far


def upside_down(
    doors: Bodies,
) -> Tensor:  # [B] int64
    """1 for doors that are the other way up than those with 0. Which of the two stand as they should is not known."""
    standing = standing_out(doors)
    differences = (standing - standing.flip(1))[:, : _CELLS[0] // 2].flatten(1)
    scaled, _ = scaled_and_capped(differences.double().cpu().numpy())
    said = torch.from_numpy(scaled @ decision_direction(scaled)) < 0
    return said.long().to(doors.points.device)


def standing_out(
    doors: Bodies,
) -> Tensor:  # [B, 6, 4]
    """How far what is in each cell of a grid stands out of the door, at most; along the hinge, then away from it."""
    seen = torch.einsum("bsi,bij->bsj", doors.points[0], doors.frames[:, 0])
    low, high = (seen.quantile(edge, dim=1, keepdim=True) for edge in (_EDGE, 1 - _EDGE))
    cells = torch.tensor(_CELLS).to(seen)
    where = (cells * (seen - low)[..., :2] / (high - low)[..., :2]).long()
    row, column = where.clamp_min(0).minimum(cells.long() - 1).unbind(-1)
    out = (seen[..., 2].median(dim=1, keepdim=True).values - seen[..., 2]).clamp(-_OUTLYING, _OUTLYING)
    rows, columns = _CELLS
    grid = seen.new_zeros(len(seen), rows * columns)
    return grid.scatter_reduce(1, row * columns + column, out, "amax", include_self=False).view(-1, rows, columns)
