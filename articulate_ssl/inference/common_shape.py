"""A dense shape that training clouds of a category have in common, which takes clouds' proportions in the end.

The category's own is some cloud's, and the network learnt with it. Laid over each other by what is predicted of them,
clouds show a better one (`shape.fusion`), in the same canonical space: with straight walls, without what that one
object has alone, and without pieces that are of another part. No label is read.
"""

from __future__ import annotations

import torch

from articulate_ssl.inference.late_buffers import LateBuffers
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.joints import Joints


class CommonShape(LateBuffers):
    """Points of K parts, once they are learnt.

    Attributes:
        points: [K, M, 3] canonical object space at joint states zero; M is 0 until they are learnt.
        pivot: [J, 3] points on the joint lines.
    """

    def __init__(self, num_parts: int) -> None:
        """Args: K."""
        super().__init__()
        self.register_buffer("points", torch.zeros(num_parts, 0, 3))
        self.register_buffer("pivot", torch.zeros(num_parts - 1, 3))

    def _load_from_state_dict(self, state_dict: dict, prefix: str, *rest) -> None:
        self.points = self.points.new_zeros(state_dict.get(prefix + "points", self.points).shape)
        super()._load_from_state_dict(state_dict, prefix, *rest)

    @property
    def learnt(self) -> bool:
        """Whether there is one."""
        return self.points.shape[1] > 0

    def set(self, shape: ArticulatedShape) -> None:
        """Take over points, as many of every part, and pivots."""
        self.points = shape.points.unflatten(0, (shape.num_parts, -1)).clone()
        self.pivot = shape.joints.pivot.clone()

    def forget(self) -> None:
        """As before it was learnt."""
        self.points = self.points[:, :0]

    def shape(self, joints: Joints) -> ArticulatedShape:
        """It, with joints."""
        parts, count = self.points.shape[:2]
        label = torch.arange(parts, device=self.points.device).repeat_interleave(count)
        return ArticulatedShape(self.points.flatten(0, 1), label, joints)
