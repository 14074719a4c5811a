"""A category that is one object's true shape, in place of a network."""

from types import SimpleNamespace

import torch

from articulate_ssl.network.heads.shape import CanonicalShape
from articulate_ssl.network.heads.structure import Structure
from articulate_ssl.network.hypotheses import Hypotheses
from articulate_ssl.shape.articulated_shape import ArticulatedShape


class Category:
    """As `FinalFit` sees a network; every part of the shape has as many points, part by part."""

    def __init__(self, shape: ArticulatedShape) -> None:
        self.shape, self.joint_type = shape, shape.joints.joint_type
        self.category = SimpleNamespace(articulated_shape=lambda _type: shape)

    def category_at(self, base: torch.Tensor, state: torch.Tensor) -> Hypotheses:
        shape, (count, poses) = self.shape, base.shape[:2]
        parts = torch.stack([shape.part(part) for part in range(shape.num_parts)])
        center = parts.mean(dim=1)
        axis, pivot = shape.joints.axis.expand(count, poses, -1, 3), shape.joints.pivot.expand(count, -1, 3)
        return Hypotheses(
            CanonicalShape(*(x.expand(count, *x.shape) for x in (parts - center[:, None], center))),
            Structure(torch.zeros(count, 1), pivot, axis, pivot, axis, shape.joints.chain, self.joint_type),
            base,
            state,
            torch.zeros(count, 0, shape.num_parts),
        )
