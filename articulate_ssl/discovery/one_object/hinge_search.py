"""Where the hinge of an object is, looked for everywhere, once its body is placed.

Coarse discovery may have a door turn by half of what it does, about a line that is far off: most of its points then
stay near surfaces that were seen, and rounds of labels and adjustment do not leave that. Of six washing machines, whose
bodies were placed to a tenth of a degree, it had three so (docs/experiments.md, step 315). But what lies off the
surfaces of other clouds, moved with the body, is what moves; and how it moves about an axis, a point of the hinge says,
and one state for each cloud.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from articulate_ssl.discovery.distance_field import DistanceFields
from articulate_ssl.discovery.one_object.adjustment import Placed
from articulate_ssl.discovery.one_object.moving_labels import CAP, moving_costs
from articulate_ssl.discovery.one_object.surface import Surface
from articulate_ssl.geometry.screw import REVOLUTE, axis_angle_to_rotation
from articulate_ssl.geometry.se3 import invert_se3, transform_points
from articulate_ssl.shape.joints import Joints

# Chosen, not tuned: adjustment makes exact what is found.
_POINTS = 1024  # of every cloud, among which those that move are looked for
_COMPARED = 64  # of those
_FEWEST = 8  # of those, in every cloud
_FAR = 0.1  # normalised units: what is farther is no match
_MARGIN = 0.1  # normalised units: hinges are that near what moves
_STEP, _TURN = 0.05, 10.0  # of hinges on a grid, in normalised units, and of states, in degrees
_BEST, _FINER, _AROUND = 3, 4, 4  # lines that are looked at again, by so much finer steps, as many to either side


def has_one_hinge(joints: Joints) -> bool:
    """Whether they are of two parts, one of which turns."""
    return joints.joint_type == REVOLUTE and joints.chain.num_parts == 2


def turned_anew(placed: Placed, surfaces: Sequence[Surface]) -> Placed | None:
    """The same bodies, and the line and the states that explain best what moves.

    Args:
        placed: Of n clouds, with one hinge, whose body is placed well, and whose axis is about right.
        surfaces: n, in their own frames.

    Returns:
        That, roughly; None if hardly anything moves.
    """
    moving = _moving(placed, surfaces)
    if min(map(len, moving)) < _FEWEST:
        return None
    middle = torch.cat(moving).mean(dim=0)
    clouds = [(points - middle).float() for points in moving]
    pivot, state = _line(clouds, placed.joints.axis[0].float())
    joints = replace(placed.joints, pivot=pivot.double()[None] + middle)
    return replace(placed, joints=joints, state=state.double()[:, None])


def _moving(placed: Placed, surfaces: Sequence[Surface]) -> list[Tensor]:
    """Of each cloud those points [m, 3], in canonical object space, that lie off other clouds' surfaces, moved so."""
    cost = moving_costs(list(surfaces), placed.base[:, None].numpy(), _POINTS)[..., 0]
    back = invert_se3(placed.base)
    return [
        transform_points(pose, torch.from_numpy(surface.points[: len(far)][far > CAP / 2]))
        for pose, surface, far in zip(back, surfaces, cost, strict=True)
    ]


def _line(
    clouds: Sequence[Tensor],  # n of [m, 3]: what moves
    axis: Tensor,  # [3]
) -> tuple[Tensor, Tensor]:  # [3], [n]
    """A point of the line about which all of them are the same, turned, and by how much."""
    across = torch.linalg.svd(axis[None]).Vh[1:]  # [2, 3]
    low, high = (bound(torch.cat(list(clouds)) @ across.T, dim=0).values for bound in (torch.min, torch.max))
    ticks = (torch.arange(a - _MARGIN, b + _MARGIN, _STEP) for a, b in zip(low.tolist(), high.tolist(), strict=True))
    fits = _Fits(clouds, axis)
    rough = torch.cartesian_prod(*ticks) @ across
    apart, _ = fits.of(rough, _turns(_TURN))
    finer = torch.arange(-_AROUND, _AROUND + 1) * (_STEP / _FINER)
    near = torch.cartesian_prod(finer, finer) @ across
    lines = (rough[apart.topk(min(_BEST, len(rough)), largest=False).indices][:, None] + near).flatten(0, 1)
    apart, state = fits.of(lines, _turns(_TURN / 2))
    return lines[apart.argmin()], state[:, apart.argmin()]


def _turns(step: float) -> Tensor:
    return torch.arange(-180.0, 180.0, step).deg2rad()


class _Fits:
    """How well clouds are the one that shows most, turned about lines of one direction."""

    def __init__(self, clouds: Sequence[Tensor], axis: Tensor) -> None:
        self.axis = axis
        self.fields = [DistanceFields.of(cloud[None]) for cloud in clouds]
        some = (np.random.default_rng(0).permutation(len(cloud))[:_COMPARED] for cloud in clouds)
        self.points = [cloud[rows] for cloud, rows in zip(clouds, some, strict=True)]
        self.most = max(range(len(clouds)), key=lambda index: len(clouds[index]))

    def of(
        self,
        lines: Tensor,  # [P, 3] points of them
        turns: Tensor,  # [T] radians
    ) -> tuple[Tensor, Tensor]:  # [P], [n, P]
        """How far points are apart, both ways, in the mean of clouds; and at which turn of each cloud least."""
        shown, field = self.points[self.most], self.fields[self.most]
        state, apart = torch.zeros(len(self.points), len(lines)), torch.zeros(len(lines))
        rotation = axis_angle_to_rotation(self.axis.expand(len(turns), 3), turns)
        for index, (points, own) in enumerate(zip(self.points, self.fields, strict=True)):
            if index == self.most:
                continue
            far = torch.stack([_apart(turn, lines, shown, own, points, field) for turn in rotation])
            least, best = far.min(dim=0)
            apart += least / (len(self.points) - 1)
            state[index] = turns[best]
        return apart, state


def _apart(
    rotation: Tensor,  # [3, 3]
    lines: Tensor,  # [P, 3]
    shown: Tensor,  # [m, 3] points that are turned
    field: DistanceFields,  # of the cloud that they are compared with
    points: Tensor,  # [m', 3] of that cloud, turned back
    shown_field: DistanceFields,
) -> Tensor:  # [P]
    shift = (lines - lines @ rotation.T)[:, None]
    there = field.at(0, shown @ rotation.T + shift)
    back = shown_field.at(0, (points - shift) @ rotation)
    return there.clamp(max=_FAR).mean(dim=1) + back.clamp(max=_FAR).mean(dim=1)
