"""Manhattan frames of whole clouds, made exact: along their axes a cloud's points pile up at its planes.

Normals of few neighbours are blunt where planes are thin or noisy, and where most planes are parallel they leave it
open how the frame is turned about their normal: of generated safes one frame in six was wrong by 6 to 51 degrees, of
ovens one in twenty. How often points have which coordinate along an axis is not blunt: it has a peak for every plane
across that axis, and the better a frame is turned, the sharper those are. Where a cloud shows few of its planes, as a
depth view does, this is worse than normals (docs/experiments.md, steps 328 and 340).
"""

from __future__ import annotations

import math

import roma
import torch
from torch import Tensor

# From coarse to fine: how wide cells are in which points are counted, in units of the clouds, and by how much frames
# are turned on trial, in degrees.
_CELLS = ((0.03, 4.0), (0.015, 1.5), (0.008, 0.6))
_TRIALS, _ROUNDS = 32, 4  # in each round, around the best of the last, ever nearer to it
_NEARER = 0.5  # how much nearer in the last round than in the first
_POINTS, _FEW = 2048, 1024  # that are counted, and to choose among frames that are far from each other
_TURNS = 18  # of a quarter turn about an axis, on trial


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


def sharp_frame(
    cloud: Tensor,  # [N, 3] an even sample of the surface, and so are its leading points
    rotation: Tensor,  # [3, 3] to its frame, roughly, or to another
    others: Tensor,  # [S, 3, 3] that may be nearer
) -> Tensor:  # [3, 3]
    """Of that frame, the best near it, and the best near one of the others, turned about its axes: the sharpest."""
    few = cloud[:_FEW]
    turned = _sharpest(few, others, _CELLS[0][0])
    for _ in range(2):
        turned = _sharpest(few, _about_axes().to(cloud) @ turned, _CELLS[0][0])
    points = cloud[:_POINTS]
    # By the same turns for every cloud: what is found of one does not depend on others.
    nearby = [sharpened(points, one, torch.Generator().manual_seed(0)) for one in (rotation, turned)]
    return _sharpest(points, torch.stack([rotation, *nearby]), _CELLS[-1][0])


def sharpened(
    cloud: Tensor,  # [N, 3]
    rotation: Tensor,  # [3, 3] to its frame, roughly
    generator: torch.Generator,
) -> Tensor:  # [3, 3]
    """The frame nearby along which points pile up most."""
    for cell, degrees in _CELLS:
        for step in range(_ROUNDS):
            size = math.radians(degrees) / math.sqrt(3) * (1 - _NEARER * step / _ROUNDS)
            turn = size * torch.randn(_TRIALS, 3, generator=generator)
            turn[0] = 0  # none
            rotation = _sharpest(cloud, roma.rotvec_to_rotmat(turn).to(cloud) @ rotation, cell)
    return rotation


def _sharpest(
    cloud: Tensor,  # [N, 3]
    rotations: Tensor,  # [S, 3, 3]
    cell: float,
) -> Tensor:  # [3, 3]
    return rotations[sharpness(cloud @ rotations.mT, cell).argmax()]


def _about_axes() -> Tensor:  # [3 * _TURNS - 2, 3, 3]
    """None, and turns about each coordinate axis by less than a quarter."""
    angle = torch.arange(_TURNS) * (math.pi / 2 / _TURNS)
    turns = roma.rotvec_to_rotmat(angle[:, None, None] * torch.eye(3))
    return torch.cat([turns[:1, 0], turns[1:].flatten(0, 1)])
