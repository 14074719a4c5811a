"""Clouds in other proportions and joint states: of few objects, what many would show.

Chests differ in how high their drawers are and how far these stand open. Both can be varied in a cloud without knowing
more of it than which points slide together: every axis of its box is stretched here and compressed there, which keeps
what lies above, below and beside, and parts slide along their axes.
"""

from __future__ import annotations

import torch
from torch import Tensor

from articulate_ssl.discovery.similar_clouds import LabelledClouds
from articulate_ssl.discovery.synchronization import unit_boxes
from articulate_ssl.shape.joints import Joints

_INTERVALS = 5  # of every axis, each stretched by its own factor
_STRETCH = 0.4  # standard deviation of the factors' logarithms
_SLIDE = 0.15  # standard deviation of how far parts slide, in widths of the box
# Copies of labelled clouds: of 232 clouds without 70 % mIoU, with 4 copies 73 %, 8 73 %, 16 78 %, 48 79 % (step 103).
# So as many as make so many clouds, within these limits, which are chosen.
_CLOUDS, _FEWEST_COPIES, _MOST_COPIES = 4000, 4, 16


def in_other_proportions(
    clouds: Tensor,  # [n, N, 3]
    copies: int,
    generator: torch.Generator,
) -> Tensor:  # [(1 + copies) n, N, 3]
    """The clouds themselves, then copies of all in the same boxes, each stretched unevenly along every axis."""
    return torch.cat([clouds] + [_stretched(clouds, generator) for _ in range(copies)])


def _stretched(clouds: Tensor, generator: torch.Generator) -> Tensor:
    """Piecewise linear and rising along every axis, so that no two points change places."""
    drawn = torch.randn(len(clouds), _INTERVALS, 3, generator=generator).to(clouds)
    ends = torch.nn.functional.pad((_STRETCH * drawn).exp().cumsum(dim=1), (0, 0, 1, 0))
    ends = ends / ends[:, -1:]
    low, high = clouds.amin(dim=1, keepdim=True), clouds.amax(dim=1, keepdim=True)
    place = (clouds - low) / (high - low).clamp(min=1e-6) * _INTERVALS
    interval = place.floor().clamp(max=_INTERVALS - 1).long()
    start, end = ends.gather(1, interval), ends.gather(1, interval + 1)
    return low + (high - low) * (start + (place - interval) * (end - start))


def varied(
    labelled: LabelledClouds,
    joints: Joints,  # of their parts
    generator: torch.Generator,
) -> LabelledClouds:
    """The clouds themselves, then copies of all in other proportions whose parts have slid, in unit boxes again."""
    part, found = labelled.part.long(), [labelled.points]
    copies = min(max(_CLOUDS // len(part), _FEWEST_COPIES), _MOST_COPIES)
    found += [in_other_states(labelled, joints, generator) for _ in range(copies)]
    return LabelledClouds(torch.cat(found), labelled.part.repeat(copies + 1, 1))


def in_other_states(
    labelled: LabelledClouds,
    joints: Joints,  # of their parts
    generator: torch.Generator,
) -> Tensor:  # [r, P, 3]
    """A copy of every cloud in other proportions, whose parts have slid, in unit boxes."""
    part = labelled.part.long()
    slide = joints.axis.new_zeros(len(joints.axis) + 1, 3).index_copy(0, torch.tensor(joints.chain.child), joints.axis)
    moved = _SLIDE * torch.randn(len(part), len(slide), generator=generator).to(slide)  # [n, K]
    shift = (moved[..., None] * slide).gather(1, part[..., None].expand(-1, -1, 3))
    return unit_boxes(_stretched(labelled.points, generator) + shift)[0]
