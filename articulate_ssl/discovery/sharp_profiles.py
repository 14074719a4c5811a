"""A Manhattan frame, made exact: along its axes a cloud's points pile up at its planes.

Normals of few neighbours are blunt where planes are thin or noisy, and blunt alike. How often points have which
coordinate along an axis is not: it has a peak for every plane across that axis, and the better a frame is turned, the
sharper those are. Where a cloud shows few of its planes, as a depth view does, this is worse than normals
(docs/experiments.md, step 328).
"""

from __future__ import annotations

import math

import roma
import torch
from torch import Tensor

# From coarse to fine: how wide cells are in which points are counted, in units of the clouds, and by how much frames
# are turned on trial, in degrees.
_CELLS = ((0.03, 4.0), (0.015, 1.5), (0.008, 0.6))
_TRIALS, _ROUNDS = 64, 6  # in each round, around the best of the last, ever nearer to it
_NEARER = 0.5  # how much nearer in the last round than in the first


def sharpness(
    clouds: Tensor,  # [..., N, 3]
    cell: float,
) -> Tensor:  # [...]
    """Sum over the coordinate axes of the squares of how many points are in each cell along it.

    A point counts in the two cells that it lies between, by how near it is to either.
    """
    along = clouds.mT  # [..., 3, N]
    place = (along - along.amin(dim=-1, keepdim=True)) / cell
    lower = place.floor().long()
    share = place - lower
    count = clouds.new_zeros(*along.shape[:-1], int(lower.max()) + 2)
    count.scatter_add_(-1, lower, 1 - share).scatter_add_(-1, lower + 1, share)
    return count.square().sum(dim=(-2, -1))


def sharpened(
    clouds: Tensor,  # [n, N, 3]
    rotation: Tensor,  # [n, 3, 3] to their frames, roughly
    generator: torch.Generator,
) -> Tensor:  # [n, 3, 3]
    """The frames nearby along which points pile up most."""
    return torch.stack([_sharpened(*one, generator) for one in zip(clouds, rotation, strict=True)])


def _sharpened(
    cloud: Tensor,  # [N, 3]
    rotation: Tensor,  # [3, 3]
    generator: torch.Generator,
) -> Tensor:  # [3, 3]
    for cell, degrees in _CELLS:
        for step in range(_ROUNDS):
            size = math.radians(degrees) / math.sqrt(3) * (1 - _NEARER * step / _ROUNDS)
            turn = size * torch.randn(_TRIALS, 3, generator=generator)
            turn[0] = 0  # none
            trials = roma.rotvec_to_rotmat(turn).to(cloud) @ rotation
            rotation = trials[sharpness(cloud @ trials.mT, cell).argmax()]
    return rotation
