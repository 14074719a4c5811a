"""Views of scans, told as the category is, though discovery that is done once more may lay canonical space otherwise.

Other code, or another draw, finds the same parts and hinge in another canonical space, and counts joint states from
elsewhere, or in the other sense. The category's shape, registered to what was found, says how.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from articulate_ssl.discovery.from_scans import StandingScans
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.discovery.registration import register_articulated
from articulate_ssl.discovery.reshaping import point_parts
from articulate_ssl.discovery.search import search_articulated
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.training.set_clouds import SetClouds

if TYPE_CHECKING:
    from articulate_ssl.training.module import ArticulatedPoseModule

# Degrees and length by which hinges differ at most, of a shape and of what discovery found, or found once more. Chosen:
# training moves them by about one degree and a hundredth.
_ANGLE, _APART = 10.0, 0.1
_OF_PART = 300  # points by which shapes are registered
_FINER, _ROUNDS = (0.03, 0.003), 20  # scales of that after the search
_AT_ONCE = 16  # scans whose faces are looked at

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ScanSpace:
    """Where the canonical space of a category with one joint is in that of what was found.

    Attributes:
        shape: The category's.
        frame: [4, 4] its canonical object space -> that of what was found, as large as the category's.
        state: [1] joint state, as the category counts, of what has the state `found`.
        found: [1]
        sense: [1] 1, or -1 if the one counts up where the other counts down.
    """

    shape: ArticulatedShape
    frame: Tensor
    state: Tensor
    found: Tensor
    sense: Tensor

    @staticmethod
    def of(
        shape: ArticulatedShape,
        found: RegisteredShape,
        starts: Tensor,  # [Q, 1] states from which the category's is sought, the middle of what was seen first
    ) -> ScanSpace | None:
        """Of a shape that is registered to what was found; None if they do not have about the same joint then."""
        shape, starts, state = _beside(shape, found.base), starts.to(found.base), found.state.median(dim=0).values
        size, other = (_size(_posed(one, at)) for one, at in ((shape, starts[0]), (found.shape, state)))
        other = found.shape.scaled(float(size / other))  # views are larger or smaller than scans
        cloud = _posed(other, state)
        cloud = cloud[:, torch.randperm(cloud.shape[1], generator=torch.Generator().manual_seed(0))]
        frame, own, _ = search_articulated(shape, cloud, rotation_group(60).elements.to(cloud), starts)
        frame, own, _ = register_articulated(shape, cloud, frame[:, 0], own[:, 0], _FINER, _ROUNDS)
        placed = shape.in_frame(frame[0])
        if not _same_line(other, placed):
            return None
        sense = (other.joints.axis * placed.joints.axis).sum(dim=-1).sign()
        return ScanSpace(shape, frame[0], own[0], state, sense)

    def views(
        self,
        scans: StandingScans,
        num_points: int,
        generator: np.random.Generator,
        count: int,
        limits: Tensor,  # [2] between which joint states are, as the category counts
    ) -> tuple[Tensor, RegisteredShape]:
        """`StandingScans.views`, and the category's shape registered to them."""
        ends = self.found_states(limits[:, None].to(self.found)).T.sort()[0]
        views, found = scans.views(num_points, generator, count, ends)
        return views, replace(found, shape=self.shape, base=found.base @ self.frame, state=self.states(found.state))

    @staticmethod
    def of_scans(module: ArticulatedPoseModule, data: SetClouds, lesson: str) -> tuple[StandingScans, ScanSpace] | None:
        """The scans that taught a module views, and where its category is in them; None, and a warning, if nowhere."""
        scans, category = module.recipe.standing_scans(data, module.num_points), module.articulated.category
        shape = category.articulated_shape(module.articulated.joint_type)
        space = ScanSpace.of(shape, scans.found, module.states.starts())
        if space is None:
            log.warning("%s: discovery found the hinge elsewhere than it is now: there are no views of them", lesson)
            return None
        state = space.square_states(scans, module)
        return replace(scans, found=replace(scans.found, state=state)), space

    def square_states(self, scans: StandingScans, module: ArticulatedPoseModule) -> Tensor:  # [n, 1]
        """Joint states of scans, as what was found counts them, in which parts are square to their faces.

        Registration turns a door to where it fits best, and in an object of other proportions than the shape's that is
        a few degrees off. Closed by its own state it would gape then, or lie within the body, and views would show
        what no closed door shows.
        """
        base, state = (scans.found.base @ self.frame)[:, None], self.states(scans.found.state)[:, None]
        part, squared = point_parts(scans.found, scans.clouds), []
        for rows in torch.arange(len(base)).split(_AT_ONCE):
            dense, own = scans.clouds[rows].to(module.device), part[rows].to(module.device)
            placed = module.articulated.category_at(base[rows].to(module.device), state[rows].to(module.device))
            squared.append(module.part_frames.settled(placed, dense, part=own)[0].state[:, 0])
        return self.found_states(torch.cat(squared).to(scans.found.state))

    def found_states(self, state: Tensor) -> Tensor:
        """Joint states of the category, as what was found counts them."""
        return self.found + self.sense * (state - self.state)

    def states(self, found: Tensor) -> Tensor:
        """The other way."""
        return self.state + self.sense * (found - self.found)


def _beside(shape: ArticulatedShape, found: Tensor) -> ArticulatedShape:
    """The same where discovery works, which is on the CPU."""
    joints = replace(shape.joints, axis=shape.joints.axis.to(found), pivot=shape.joints.pivot.to(found))
    return replace(shape, points=shape.points.to(found), label=shape.label.to(found.device), joints=joints)


def _posed(
    shape: ArticulatedShape,
    state: Tensor,  # [1]
) -> Tensor:  # [1, K * _OF_PART, 3]
    """In canonical space, as many points of every part: a category's shape has so, what was found has not."""
    whole = shape.posed(torch.eye(4).to(shape.points)[None], state[None])
    rows = [(shape.label == part).nonzero()[:, 0] for part in range(shape.num_parts)]
    return whole[:, torch.cat([own[torch.linspace(0, len(own) - 1, _OF_PART).round().long()] for own in rows])]


def _size(points: Tensor) -> Tensor:  # [1, T, 3], []
    """Root mean square distance from their mean."""
    return (points - points.mean(dim=1, keepdim=True)).square().sum(dim=-1).mean().sqrt()


def _same_line(one: ArticulatedShape, other: ArticulatedShape) -> bool:
    """Whether two shapes have about the same joint, in either sense."""
    axis, pivot = other.joints.axis[0], other.joints.pivot[0]
    cosine = (one.joints.axis[0] @ axis).abs()
    between = torch.linalg.cross(one.joints.pivot[0] - pivot, axis).norm()
    return bool(cosine > math.cos(math.radians(_ANGLE)) and between < _APART)
