"""How objects whose parts slide are turned in depth views: square to the Manhattan frames of these.

All parts of a chest are square to each other, in every state. So even one view, of three faces, says to a fraction of
a degree how it is turned (`discovery.manhattan_frame`), up to the 24 rotations of the cube; registration, which says
between these, is off by several degrees, as it turns one shape to objects of other proportions and does not see their
backs. How the frame lies in canonical object space, predictions of training views say together; no label is read.
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
from articulate_ssl.inference.late_buffers import LateBuffers
from articulate_ssl.network.hypotheses import Hypotheses

_REACH = (40.0, 20.0)  # degrees: predictions farther from their frames do not count, in the first round and in the last
_ROUNDS = 6
_SHARE = 0.8  # the frame is learnt if so many of the views have one near their predictions. Chosen.
_PARALLEL = 5.0  # degrees: a joint that is so near to an axis of the frame is parallel to that


class ObjectFrame(LateBuffers):
    """Of a category, in canonical object space.

    Attributes:
        axes: [3, 3] columns, at right angles, right-handed.
        known: Whether it was learnt.
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
    square = frame.mT[:, None] @ rotation_group(24).elements.to(frame) @ axes.mT
    angle = roma.rotmat_geodesic_distance(square, turn[:, None].expand_as(square)).rad2deg()
    best = angle.argmin(dim=1)
    rows = torch.arange(len(turn), device=turn.device)
    return square[rows, best], angle[rows, best]
