"""Where the hinge of an object is, looked for everywhere, once its body is placed.

Coarse discovery may have a door turn by half of what it does, about a line that is far off: most of its points then
stay near surfaces that were seen, and rounds of labels and adjustment do not leave that. Of six washing machines it had
three so, whose bodies were placed to a tenth of a degree (docs/experiments.md, step 315). But what lies off the
surfaces of other clouds, moved with the body, is what moves; and how it moves about an axis, a point of the hinge says,
and one state for each cloud.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

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
from articulate_ssl.shape.stretch import principal_directions

# Chosen, not tuned: adjustment makes exact what is found.
_POINTS = 1024  # of every cloud, among which those that move are looked for
_COMPARED = 64  # of those; in a first look half of them
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

    Lines are parallel to the axis, or to a principal direction of the body.

    Args:
        placed: Of n clouds, with one hinge, whose bodies are placed well.
        surfaces: n, in their own frames.

    Returns:
        That, roughly; None if hardly anything moves.
    """
    moving, body = _parted(placed, surfaces)
    if min(map(len, moving)) < _FEWEST:
        return None
    middle = torch.cat(moving).mean(dim=0)
    fits = _Fits([(points - middle).float() for points in moving])
    axes = torch.cat([placed.joints.axis, principal_directions(body).mT]).float()
    line = fits.finely(min((fits.roughly(axis) for axis in axes), key=lambda line: line.apart))
    joints = replace(placed.joints, axis=line.axis.double()[None], pivot=line.pivots[:1].double() + middle)
    return replace(placed, joints=joints, state=line.state.double()[:, None])


def _parted(placed: Placed, surfaces: Sequence[Surface]) -> tuple[list[Tensor], Tensor]:
    """Points in canonical object space, by whether they lie off other clouds' surfaces, moved with bodies.

    Returns:
        Of each cloud those that do [m, 3]; and of all clouds those that do not [m', 3].
    """
    cost = moving_costs(list(surfaces), placed.base[:, None].numpy(), _POINTS)[..., 0]
    points = [torch.from_numpy(surface.points[: len(far)]) for surface, far in zip(surfaces, cost, strict=True)]
    resting = [transform_points(pose, own) for pose, own in zip(invert_se3(placed.base), points, strict=True)]
    off = torch.from_numpy(cost > CAP / 2)
    return [own[moves] for own, moves in zip(resting, off, strict=True)], torch.cat(resting)[~off.flatten()]


class _Line(NamedTuple):
    """A hinge's line.

    Attributes:
        axis: [3].
        pivots: [B, 3] points of lines, the best first.
        apart: How far points are then apart.
        state: [n] by how much each cloud is turned.
    """

    axis: Tensor
    pivots: Tensor
    apart: float
    state: Tensor


def _turns(step: float) -> Tensor:
    return torch.arange(-180.0, 180.0, step).deg2rad()


class _Fits:
    """How well clouds [m, 3], about the origin, are the one that shows most, turned about lines."""

    def __init__(self, clouds: Sequence[Tensor]) -> None:
        self.reach = torch.cat(list(clouds)).abs().amax(dim=0) + _MARGIN
        self.fields = [DistanceFields.of(cloud[None]) for cloud in clouds]
        some = (np.random.default_rng(0).permutation(len(cloud))[:_COMPARED] for cloud in clouds)
        self.points = [cloud[rows] for cloud, rows in zip(clouds, some, strict=True)]
        self.most = max(range(len(clouds)), key=lambda index: len(clouds[index]))

    def roughly(
        self,
        axis: Tensor,  # [3]
    ) -> _Line:
        """The best lines of that direction."""
        across = _across(axis)
        ticks = [torch.arange(-far, far, _STEP) for far in (across.abs() @ self.reach).tolist()]
        return self._best(axis, torch.cartesian_prod(*ticks) @ across, _TURN, _COMPARED // 2)

    def finely(self, line: _Line) -> _Line:
        """What is better nearby."""
        across = _across(line.axis)
        finer = torch.arange(-_AROUND, _AROUND + 1) * (_STEP / _FINER)
        near = torch.cartesian_prod(finer, finer) @ across
        return self._best(line.axis, (line.pivots[:, None] + near).flatten(0, 1), _TURN / 2, _COMPARED)

    def _best(self, axis: Tensor, lines: Tensor, step: float, count: int) -> _Line:  # lines [P, 3]
        """Of lines those for which points are least apart, both ways, in the mean of clouds."""
        turns = _turns(step)
        rotation = axis_angle_to_rotation(axis.expand(len(turns), 3), turns)
        shown, field = self.points[self.most][:count], self.fields[self.most]
        state, apart = torch.zeros(len(self.points), len(lines)), torch.zeros(len(lines))
        for index, (points, own) in enumerate(zip(self.points, self.fields, strict=True)):
            if index != self.most:
                far = torch.stack([_apart(turn, lines, shown, own, points[:count], field) for turn in rotation])
                least, best = far.min(dim=0)
                apart += least / (len(self.points) - 1)
                state[index] = turns[best]
        order = apart.topk(min(_BEST, len(lines)), largest=False).indices
        return _Line(axis, lines[order], float(apart[order[0]]), state[:, order[0]])


def _across(axis: Tensor) -> Tensor:  # [3] -> [2, 3]
    return torch.linalg.svd(axis[None]).Vh[1:]


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
