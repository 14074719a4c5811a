"""A category that is one object's true shape, in place of a network."""

from dataclasses import replace
from types import SimpleNamespace

import torch

from articulate_ssl.inference.common_shape import CommonShape
from articulate_ssl.inference.final_fit import FinalFit
from articulate_ssl.inference.hypothesis_registration import HypothesisRegistration
from articulate_ssl.inference.object_frame import ObjectFrame
from articulate_ssl.inference.options import InferenceOptions
from articulate_ssl.inference.part_frames import PartFrames
from articulate_ssl.inference.state_range import StateRange
from articulate_ssl.inference.view_search import ViewSearch
from articulate_ssl.network.heads.shape import CanonicalShape
from articulate_ssl.network.heads.structure import Structure
from articulate_ssl.network.hypotheses import Hypotheses
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.observation import Observation


class Category:
    """As `FinalFit` sees a network; every part of the shape has as many points, part by part."""

    def __init__(self, shape: ArticulatedShape) -> None:
        self.shape, self.joint_type, self.num_parts = shape, shape.joints.joint_type, shape.num_parts
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


def final_fit(shape: ArticulatedShape, states: StateRange) -> FinalFit:
    """Of that category; nothing is learnt but where joint states are."""
    order = shape.label.argsort(stable=True)
    network = Category(replace(shape, points=shape.points[order], label=shape.label[order]))
    options = InferenceOptions(refine=True, proportions=6)
    registration = HypothesisRegistration(options, Observation(), states)
    learnt = PartFrames(shape.num_parts), CommonShape(shape.num_parts), ViewSearch(shape.num_parts), ObjectFrame()
    return FinalFit(network, registration, *learnt, options.proportions)
