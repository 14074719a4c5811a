"""Views of closed doors, of which training showed none: doors are closed in scans, and cameras simulated before them.

No label is read. Discovery has found parts and hinges in scans of open doors, and simulates views of them, in other
proportions and joint states, which teach the network. Faces say at which state a door is closed, or the box about it
where it has none, as round ones, so there are views of states from there to where training begins, as well. They are
kept apart (`inference.other_views`): a network that is taught by closed doors, too, explains open ones worse
(docs/experiments.md, step 266).
"""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from articulate_ssl.inference.hinge_sides import closed_state
from articulate_ssl.inference.state_range import StateRange
from articulate_ssl.ops.progress import tell
from articulate_ssl.training.scan_space import ScanSpace
from articulate_ssl.training.set_clouds import SetClouds

if TYPE_CHECKING:
    from articulate_ssl.training.module import ArticulatedPoseModule

# Of the width of a joint's range as seen: what is closed nearer to it is seen. Chosen.
_SEEN = 0.15

log = logging.getLogger(__name__)


@torch.no_grad()
def learn_closed_doors(
    module: ArticulatedPoseModule,
    data: SetClouds,
) -> None:
    """Keep simulated views of doors between closed and as training shows them, of what is hinged on a box."""
    estimator, states = module.estimator, module.states
    estimator.closed_views.forget()
    frames, shape = module.part_frames, module.articulated.category.articulated_shape(module.articulated.joint_type)
    if not frames.learnt:
        tell(log, "closed doors: nothing has faces that say at which state they are")
        return
    closed = closed_state(shape, states.known, frames)
    if states.showed(states.rest.new_tensor([closed]), _SEEN):
        tell(log, "closed doors: training shows them")
        return
    known = ScanSpace.of_scans(module, data, "closed doors")
    if known is None:
        return
    scans, space = known
    states.set_rest(closed)
    count = math.ceil(module.closed_views_samples / len(scans.clouds))
    limits = nearly_closed(states)
    views, found = space.views(scans, module.num_points, np.random.default_rng(0), count, limits)
    estimator.closed_views.learn(views, found.base, found.state, found.point_part, found.quarters)
    tell(log, "closed doors: %d views of doors at %.0f to %.0f degrees", len(views), *limits.rad2deg().tolist())


def nearly_closed(states: StateRange) -> Tensor:  # [2]
    """Joint states between a closed door's and the nearest that training shows."""
    ends = states.known[0]
    nearest = ends[(ends - states.rest).abs().argmin()]
    return torch.stack([states.rest[0], nearest]).sort().values
