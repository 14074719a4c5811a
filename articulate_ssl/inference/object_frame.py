"""How objects whose parts slide are turned in depth views: square to the Manhattan frames of these.

All parts of a chest are square to each other, in every state. So even one view, of three faces, says to a fraction of
a degree how it is turned (`discovery.manhattan_frame`), up to the 24 rotations of the cube; registration, which says
between these, is off by several degrees, as it turns one shape to objects of other proportions and does not see their
backs. How the frame lies in canonical object space, predictions of training views say together.

Which of the 24 it is, predictions get wrong in one view of twenty, mostly by a quarter turn. A network that they taught
sees the surface; with it one development view of a hundred or less is wrong (docs/experiments.md, step 189). No label
is read.
"""

from __future__ import annotations

import math
from dataclasses import replace

import roma
import torch
from torch import Tensor

from articulate_ssl.discovery.manhattan_frame import CAP, manhattan_frames
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.inference.surface_decision import WithSurface
from articulate_ssl.network.hypotheses import Hypotheses

_REACH = (40.0, 20.0)  # degrees: predictions farther from their frames do not count, in the first round and in the last
_ROUNDS = 6
_SHARE = 0.8  # the frame is learnt if so many of the views have one near their predictions. Chosen.
_SURE = 2.0  # odds by which another turn has to look right to take the place of the one that is held to be. Chosen.
_PARALLEL = 5.0  # degrees: a joint that is so near to an axis of the frame is parallel to that


class ObjectFrame(WithSurface):
    """Of a category, in canonical object space.

    Attributes:
        axes: [3, 3] columns, at right angles, right-handed.
        known: Whether it was learnt.
        surface: Which of the rotations that are square to it looks right, if that was taught.
    """

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("axes", torch.eye(3))
        self.register_buffer("known", torch.zeros((), dtype=torch.bool))

    @property
    def learnt(self) -> bool:
        """Whether views' frames say how objects are turned."""
        return bool(self.known)

    def forget(self) -> None:
        """As before it was learnt."""
        self.known.fill_(False)
        self.surface = None

    def learn(
        self,
        turn: Tensor,  # [n, 3, 3] canonical object space -> view, as predicted
        views: Tensor,  # [n, P, 3]
        start: Tensor,  # [3, 3] columns: roughly the axes
    ) -> Tensor:  # []
        """Find out how the frame lies, and whether it is any.

        Returns:
            The share of views whose frames are near their predictions.
        """
        frame, has = _frames(views)
        axes = start
        for reach in torch.linspace(*_REACH, _ROUNDS).tolist():
            nearest, angle = _nearest(frame, axes, turn)
            near = has & (angle < reach)
            axes = roma.special_procrustes((turn.mT @ nearest @ axes)[near].sum(dim=0))
        share = near.to(axes).mean()
        self.axes.copy_(axes)
        self.known.fill_(bool(share > _SHARE))
        return share

    def square(
        self,
        views: Tensor,  # [B, P, 3]
        turn: Tensor,  # [B, 3, 3] canonical object space -> view
    ) -> tuple[Tensor, Tensor]:  # [B, 24, 3, 3], [B]
        """Rotations that are square to views' frames, the nearest to a turn first; and which views have a frame."""
        frame, has = _frames(views)
        rotation = _square(frame, self.axes)
        order = _angles(rotation, turn).argsort(dim=1)
        return rotation.take_along_dim(order[..., None, None], dim=1), has

    def looked_at(
        self,
        views: Tensor,  # [B, P, 3]
        turn: Tensor,  # [B, 3, 3] canonical object space -> view, as is held to be likely
    ) -> tuple[Tensor, Tensor, Tensor]:  # [B, 3, 3], [B], [B]
        """Turns that look right, their margins, and whether they are others than were held to be likely.

        They are where the network is sure of it and a view has a frame.
        """
        square, has = self.square(views, turn)
        odds = self.surface.looks_right(square @ self.axes, views)
        most, best = odds.max(dim=1)
        other = has & (most - odds[:, 0] > _SURE)
        best = torch.where(other, best, 0)[:, None]
        own = odds.take_along_dim(best, dim=1)
        rest = odds.scatter(1, best, -torch.inf).amax(dim=1, keepdim=True)
        margin = ((own - rest) / (2 * self.surface.temperature)).tanh().clamp(min=0).squeeze(1)
        return square.take_along_dim(best[..., None, None], dim=1).squeeze(1), margin.where(has, 0.0), other

    def settled(
        self,
        one: Hypotheses,  # H = 1
        dense: Tensor,  # [B, P, 3] views
    ) -> tuple[Hypotheses, Tensor]:  # H = 1, [B]
        """Explanations turned about the middle of their shapes until they are square, and which views say that.

        Joints that nearly are become parallel to the frame.
        """
        frame, has = _frames(dense)
        old = one.base[:, 0, :3, :3]
        new = torch.where(has[:, None, None], _nearest(frame, self.axes, old)[0], old)
        middle = one.object_shape().flatten(1, 2).mean(dim=1, keepdim=True)
        place = one.base[:, 0, :3, 3] + (middle @ (old - new).mT).squeeze(1)
        structure = replace(one.structure, axis=self.parallel(one.axis))
        return replace(one, structure=structure).at(se3(new, place)[:, None], one.state), has

    def parallel(self, axis: Tensor) -> Tensor:
        """Joint axes [..., 3], those that are nearly parallel to the frame exactly so."""
        cosine = axis @ self.axes
        largest = cosine.abs().amax(dim=-1, keepdim=True)
        along = (cosine.sign() * (cosine.abs() == largest)) @ self.axes.mT
        return torch.where(largest > math.cos(math.radians(_PARALLEL)), along, axis)


def _frames(
    views: Tensor,  # [B, P, 3]
) -> tuple[Tensor, Tensor]:  # [B, 3, 3], [B]
    """Rotations view -> Manhattan frame, and whether there is one."""
    frame, angle = manhattan_frames(views, torch.Generator().manual_seed(0))
    return frame, angle < CAP


def _nearest(
    frame: Tensor,  # [B, 3, 3] view -> frame
    axes: Tensor,  # [3, 3]
    turn: Tensor,  # [B, 3, 3] canonical object space -> view
) -> tuple[Tensor, Tensor]:  # [B, 3, 3], [B]
    """Of the 24 rotations that are square to a frame that which is nearest to a turn, and how far it is, in degrees."""
    square = _square(frame, axes)
    angle = _angles(square, turn)
    best = angle.argmin(dim=1)
    rows = torch.arange(len(turn), device=turn.device)
    return square[rows, best], angle[rows, best]


def _square(
    frame: Tensor,  # [B, 3, 3] view -> frame
    axes: Tensor,  # [3, 3]
) -> Tensor:  # [B, 24, 3, 3]
    """Rotations canonical object space -> view that are square to frames."""
    return frame.mT[:, None] @ rotation_group(24).elements.to(frame) @ axes.mT


def _angles(
    rotation: Tensor,  # [B, S, 3, 3]
    turn: Tensor,  # [B, 3, 3]
) -> Tensor:  # [B, S]
    """Between them, in degrees."""
    return roma.rotmat_geodesic_distance(rotation, turn[:, None].expand_as(rotation)).rad2deg()
