"""How `inference.box_turns` is taught: by training clouds whose doors are closed as far as predictions know how.

No label is read. What is predicted says which points are the door's and about which line it turns, so it can be turned
to any state between its own and that of a closed door, which the category's shape says. Half of the times it is nearly
closed, where fits do not tell which way round a box is.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.geometry.screw import REVOLUTE, screw_motion
from articulate_ssl.geometry.se3 import transform_points
from articulate_ssl.inference.prediction import Prediction, concatenate
from articulate_ssl.ops.progress import announced, tell
from articulate_ssl.training.explanations import registered_points, with_noise
from articulate_ssl.training.surface_lessons import FEWEST, TAUGHT, learn_surface

if TYPE_CHECKING:
    from articulate_ssl.training.module import ArticulatedPoseModule

_BATCH = 16
_VERSIONS = 4  # of every cloud, in states of their own, every other one with noise
_NEARLY = 0.15  # of the way from a closed door to that of the cloud, at most, of half of the versions. Chosen.
# Share of the clouds that did not teach it, of which the network must say what is predicted: where it says otherwise of
# more, many predictions are wrong, and doors were closed about lines that are no hinges. A training of ovens had 89 %,
# and without the network half of its closed doors wrong (docs/experiments.md, step 335). Chosen.
_AGREES = 0.75

log = logging.getLogger(__name__)


@torch.no_grad()
def learn_box_turns(
    module: ArticulatedPoseModule,
    clouds: Tensor,  # [n, N, 3] farthest-point order, dense
) -> None:
    """Teach a network which way round boxes are with doors as far as closed."""
    estimator = module.estimator
    turns, search, states = estimator.box_turns, estimator.square_search, estimator.states
    turns.surface = None  # of a run that ended and goes on
    search.measure()
    if not search.known:
        return
    if TAUGHT * len(clouds) < FEWEST:
        tell(log, "boxes with closed doors: too few clouds, %d", len(clouds))
        return
    shown, count = announced(log, "predictions of boxes, to close their doors", clouds.split(_BATCH)), module.num_points
    found = concatenate([estimator.predict(x[:, : registered_points(module)], count, dense=x) for x in shown])
    # From how predictions count states to how the category's shape does.
    rest = states.rest - estimator.hinge_sides.closed * estimator.hinge_sides.learnt
    generator = torch.Generator().manual_seed(0)
    versions = [doors_closed_further(found, clouds, rest, generator) for _ in range(_VERSIONS)]
    versions[1::2] = [with_noise(some, generator) for some in versions[1::2]]
    turns.axes.copy_(estimator.part_frames.axes[int(found.joint_parent[0, 0])])
    every = rotation_group(24).elements.to(clouds)  # the identity comes first
    frames = (found.base_pose[:, :3, :3] @ turns.axes)[:, None] @ every
    order = torch.randperm(len(clouds), generator=generator).to(clouds.device)
    turns.surface = learn_surface(versions, frames, order, _AGREES)


def doors_closed_further(
    found: Prediction,  # of B clouds, two parts
    clouds: Tensor,  # [B, P, 3]
    rest: Tensor,  # [1] joint state of a closed door, as predictions count
    generator: torch.Generator,
    nearly: float = 0.5,
) -> Tensor:  # [B, P, 3]
    """Clouds whose doors are turned about their hinges, as predicted, to a state between their own and a closed one's.

    Args:
        nearly: Share of those that are turned nearly all the way.
    """
    state = found.joint_state[:, 0]
    share, chance = torch.rand(2, len(clouds), generator=generator).to(clouds)
    share = torch.where(chance < nearly, _NEARLY * share, share)
    motion = screw_motion(found.joint_axis[:, 0], found.joint_pivot[:, 0], (1 - share) * (rest - state), REVOLUTE)
    door = found.dense_part_id == found.joint_child[:, :1]
    return torch.where(door[..., None], transform_points(motion, clouds), clouds)
