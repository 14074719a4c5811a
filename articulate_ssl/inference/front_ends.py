"""Where parts are that slide, in depth views, as the points say that are held to be of them.

A view shows the fronts of drawers and not how far they reach back, so a shape that is fitted to it may lie anywhere
along the slides. Once it is known which part points are of, fronts say more: of chests joint states are a third to a
half less far off (docs/experiments.md, steps 190 and 193). Which end of a slide is the front, predictions of training
views say: joint states that are read there go with those that were fitted, at the other end, which is seldom seen, they
do less. No label is read.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from articulate_ssl.discovery.instance_fit import InstanceFit
from articulate_ssl.discovery.part_boxes import fit_part_boxes
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.inference.late_buffers import LateBuffers
from articulate_ssl.inference.object_frame import ObjectFrame
from articulate_ssl.inference.proportions import with_instances
from articulate_ssl.network.hypotheses import Hypotheses
from articulate_ssl.shape.articulated_shape import MIN_POINTS, ArticulatedShape

_PARALLEL = 0.999  # cosine of a slide and an axis of the frame
_POINTS, _CYCLES = 512, 4  # of views, and of descent: 12 cycles lose half of what places gained (step 190)
_GO_TOGETHER = 0.5  # correlation of what is read and what was fitted, of every joint, for ends to be learnt. Chosen.


class FrontEnds(LateBuffers):
    """Which ends of their slides parts show.

    Attributes:
        end: [J] 1: that to which the joint's axis points, -1: the other; 0 before it was learnt.
    """

    def __init__(self, num_joints: int) -> None:
        super().__init__()
        self.register_buffer("end", torch.zeros(num_joints))

    @property
    def learnt(self) -> bool:
        """Whether it is known."""
        return bool(self.end.all())

    def forget(self) -> None:
        """As before it was learnt."""
        self.end.zero_()

    def learn(
        self,
        frame: ObjectFrame,
        category: ArticulatedShape,
        turn: Tensor,  # [n, 3, 3] canonical object space -> view
        views: Tensor,  # [n, P, 3]
        part: Tensor,  # [n, P] which part points are held to be of
        state: Tensor,  # [n, J] as they were fitted
    ) -> Tensor:  # [J]
        """Find out which, if slides are along the frame.

        Returns:
            How states that are read there correlate with those that were fitted; 0 if slides are not.
        """
        self.forget()
        if (frame.parallel(category.joints.axis) @ frame.axes).abs().amax(dim=-1).min() < _PARALLEL:
            return self.end.clone()
        sides, go_together = torch.tensor([1.0, -1.0]).to(self.end), []
        for side in sides:
            read = _boxes(frame, category, turn, views, part, side.expand_as(self.end))[0].state
            both = torch.stack([read, state], dim=-1).transpose(0, 1)  # [J, n, 2]
            go_together.append(torch.stack([torch.corrcoef(joint.T)[0, 1] for joint in both]))
        most, side = torch.stack(go_together).max(dim=0)
        if (most > _GO_TOGETHER).all():
            self.end.copy_(sides[side])
        return most

    def placed(
        self,
        one: Hypotheses,  # H = 1, square to the frame
        frame: ObjectFrame,
        category: ArticulatedShape,
        views: Tensor,  # [B, P, 3]
        part: Tensor,  # [B, P] which part points are held to be of
    ) -> Hypotheses:  # H = 1
        """The category's shape where those points are; where too few are of the body, explanations stay.

        From there it descends to the views, as boxes leave open how faces lie within them; joint states stay.
        """
        turn = one.base[:, 0, :3, :3]
        # A test runs in inference mode, whose tensors no gradient goes through.
        with torch.inference_mode(False):
            turn, views, part = turn.clone(), views.clone(), part.clone()
            fit, axes = _boxes(frame, category, turn, views, part, self.end)
            seen, stay = views[:, :_POINTS] @ turn @ axes, torch.ones_like(fit.state, dtype=torch.bool)
            fit.optimise(seen, _CYCLES, shared=False, bidirectional=False, known=(stay[:, 0], stay))
        found = fit.instances()
        lines = replace(found.joints, axis=found.joints.axis @ axes.mT, pivot=found.joints.pivot @ axes.mT)
        new = with_instances(one, replace(found, points=found.points @ axes.mT, joints=lines))
        new = replace(new, structure=replace(new.structure, axis=lines.axis.expand_as(one.axis)))
        place = (turn @ axes @ fit.base[:, :3, 3, None]).squeeze(-1)
        new = new.at(se3(turn, place)[:, None], fit.state[:, None])
        rows = ((part == one.chain.root).sum(dim=1) >= MIN_POINTS).nonzero()[:, 0]
        return one.with_rows(rows, new.rows(rows))


def _boxes(
    frame: ObjectFrame,
    category: ArticulatedShape,
    turn: Tensor,  # [n, 3, 3]
    views: Tensor,  # [n, P, 3]
    part: Tensor,  # [n, P]
    end: Tensor,  # [J]
) -> tuple[InstanceFit, Tensor]:  # , [3, 3]
    """The shape in the boxes of parts, in coordinates along the axes of the frame, and these axes."""
    axes, joints = frame.axes, category.joints
    lines = replace(joints, axis=(frame.parallel(joints.axis) @ axes).round(), pivot=joints.pivot @ axes)
    shape = ArticulatedShape(category.points @ axes, category.label.clone(), lines)
    return fit_part_boxes(shape, views @ turn @ axes, part.long(), end), axes
