"""Views of closed doors, of which training showed none: doors are closed in scans, and cameras simulated before them.

No label is read. Discovery has found parts and hinges in scans of open doors, and simulates views of them, in other
proportions and joint states, which teach the network. Faces say at which state a door is closed, so there are views of
states from there to where training begins, as well. They are kept apart (`inference.other_views`): a network that is
taught by closed doors, too, explains open ones worse (docs/experiments.md, step 266).
"""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.discovery.registration import register_articulated
from articulate_ssl.discovery.search import search_articulated
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.inference.hinge_sides import closed_state
from articulate_ssl.ops.progress import tell
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.training.set_clouds import SetClouds

if TYPE_CHECKING:
    from articulate_ssl.training.module import ArticulatedPoseModule

# Of the width of a joint's range as seen: what is closed nearer to it is seen. Chosen.
_SEEN = 0.15
# Degrees and length by which hinges differ at most, of a shape and of what discovery found, or found once more. Chosen:
# training moves them by about one degree and a hundredth.
_ANGLE, _APART = 10.0, 0.1
_FINER, _ROUNDS = (0.03, 0.003), 20  # scales of that registration after the search

log = logging.getLogger(__name__)


@torch.no_grad()
def learn_closed_doors(
    module: ArticulatedPoseModule,
    data: SetClouds,
) -> None:
    """Keep simulated views of doors between closed and as training shows them, where faces say what closed is."""
    estimator, states = module.estimator, module.states
    estimator.closed_views.forget()
    frames, shape = module.part_frames, module.articulated.category.articulated_shape(module.articulated.joint_type)
    if not frames.flat.all():
        tell(log, "closed doors: faces do not say at which state they are")
        return
    closed = closed_state(shape, states.known, frames)
    if states.showed(states.rest.new_tensor([closed]), _SEEN):
        tell(log, "closed doors: training shows them")
        return
    scans = module.recipe.standing_scans(data, module.num_points)
    space = _Space.of(scans.found, shape, states.starts())
    if space is None:
        log.warning("closed doors: discovery found the hinge elsewhere than it is now: there are no views of them")
        return
    known = states.known[0].tolist()
    limits = torch.tensor([[closed, min(known, key=lambda end: abs(end - closed))]])
    count = math.ceil(module.closed_views_samples / len(scans.clouds))
    views, found = scans.views(module.num_points, np.random.default_rng(0), count, space.found_states(limits).sort()[0])
    states.set_rest(closed)
    state = space.states(found.state)
    estimator.closed_views.learn(views, found.base @ space.frame, state, found.point_part, found.quarters)
    tell(log, "closed doors: %d views of doors at %.0f to %.0f degrees", len(views), *limits[0].sort()[0].rad2deg())


class _Space(NamedTuple):
    """Where the category's canonical space is in that of discovery, which other code may have laid otherwise.

    Attributes:
        frame: [4, 4] canonical object space of the category -> that of what was found, as large as the category's.
        state: [1] joint state, as the category counts, of what has the state `found`.
        found: [1]
        sense: [1] 1, or -1 if the one counts up where the other counts down.
    """

    frame: Tensor
    state: Tensor
    found: Tensor
    sense: Tensor

    @staticmethod
    def of(found: RegisteredShape, shape: ArticulatedShape, starts: Tensor) -> _Space | None:
        """Of the category's shape, registered to what was found; None if they do not have about the same joint."""
        still, state = torch.eye(4).to(shape.points)[None], found.state.median(dim=0).values
        size = (_size(one.posed(still, at[None])) for one, at in ((shape, starts[0]), (found.shape, state)))
        other = found.shape.scaled(float(next(size) / next(size)))  # views are larger or smaller than scans
        posed = other.posed(still, state[None])
        cloud = posed[:, torch.randperm(posed.shape[1], generator=torch.Generator().manual_seed(0))]
        frame, own, _ = search_articulated(shape, cloud, rotation_group(60).elements.to(cloud), starts)
        frame, own, _ = register_articulated(shape, cloud, frame[:, 0], own[:, 0], _FINER, _ROUNDS)
        placed = shape.in_frame(frame[0])
        if not _same_line(other, placed):
            return None
        sense = (other.joints.axis * placed.joints.axis).sum(dim=-1).sign()
        return _Space(frame[0], own[0], state, sense)

    def found_states(self, state: Tensor) -> Tensor:
        """Joint states of the category, as what was found counts them."""
        return self.found + self.sense * (state - self.state)

    def states(self, found: Tensor) -> Tensor:
        """The other way."""
        return self.state + self.sense * (found - self.found)


def _size(points: Tensor) -> Tensor:  # [1, T, 3], []
    """Root mean square distance from their mean."""
    return (points - points.mean(dim=1, keepdim=True)).square().sum(dim=-1).mean().sqrt()


def _same_line(one: ArticulatedShape, other: ArticulatedShape) -> bool:
    """Whether two shapes have about the same joint, in either sense."""
    axis, pivot = other.joints.axis[0], other.joints.pivot[0]
    cosine = (one.joints.axis[0] @ axis).abs()
    between = torch.linalg.cross(one.joints.pivot[0] - pivot, axis).norm()
    return bool(cosine > math.cos(math.radians(_ANGLE)) and between < _APART)
