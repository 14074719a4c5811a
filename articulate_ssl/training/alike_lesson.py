"""Which training clouds `inference.alike_boxes` keeps, and how much they say.

No label is read. Predictions say how clouds stand; what they get wrong is outvoted, as several clouds most alike speak.
How much these say is what makes predictions of the same clouds likeliest, each by the others.
"""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from articulate_ssl.discovery.synchronization import distances_to_others, mean_of_nearest, unit_boxes
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.inference.alike_boxes import GALLERY_POINTS
from articulate_ssl.inference.prediction import concatenate
from articulate_ssl.ops.progress import announced, tell
from articulate_ssl.training.box_lessons import doors_closed_further
from articulate_ssl.training.explanations import registered_points

if TYPE_CHECKING:
    from articulate_ssl.training.module import ArticulatedPoseModule

_BATCH = 16
FEWEST = 64  # clouds that are kept. Chosen.
_AGREES = 0.75  # share of the clouds that others have to see as predicted, as of `box_turns`
_WRONG = 0.02  # share of predictions that may be wrong, and then any way. Chosen.
_WEIGHTS = 2.0 ** torch.arange(0, 7.5, 0.5)  # that are tried

log = logging.getLogger(__name__)


@torch.no_grad()
def learn_alike_boxes(
    module: ArticulatedPoseModule,
    clouds: Tensor,  # [n, N, 3] farthest-point order, dense
) -> None:
    """Keep clouds of boxes as predictions turn them, as they are and with their doors nearly closed."""
    estimator = module.estimator
    turns, search, sides = estimator.box_turns, estimator.square_search, estimator.hinge_sides
    turns.alike.forget()  # of a run that ended and goes on
    search.measure()
    if not search.known:
        return
    shown, count = announced(log, "predictions of boxes, to compare with", clouds.split(_BATCH)), module.num_points
    found = concatenate([estimator.predict(x[:, : registered_points(module)], count, dense=x) for x in shown])
    if not turns.learnt:
        turns.axes.copy_(estimator.part_frames.axes[int(found.joint_parent[0, 0])])
    if sides.learnt:  # what is hinged elsewhere than most looks as if it lay
        axis = (found.base_pose[:, :3, :3].mT @ found.joint_axis[:, 0, :, None])[..., 0]
        usual = (sides.hinged(axis) == 0).nonzero()[:, 0]
        found, clouds = found[usual], clouds[usual]
    if len(clouds) < FEWEST:
        tell(log, "boxes that are alike: too few clouds, %d", len(clouds))
        return
    rest = estimator.states.rest - sides.closed * sides.learnt
    closed = doors_closed_further(found, clouds, rest, torch.Generator().manual_seed(0), nearly=1.0)
    frames = found.base_pose[:, :3, :3] @ turns.axes
    weight, agrees = _what_they_say(clouds.cpu(), closed.cpu(), frames.cpu())
    tell(log, "of boxes others that are alike say %.0f %% as predicted, weight %.0f", 100 * agrees, weight)
    if agrees >= _AGREES:
        turns.alike.learn(torch.cat([clouds @ frames, closed @ frames]), weight)


def _what_they_say(
    clouds: Tensor,  # [n, N, 3]
    closed: Tensor,  # [n, N, 3] the same with their doors nearly closed
    frames: Tensor,  # [n, 3, 3] in which they stand -> camera
) -> tuple[float, float]:
    """What differences count, and of which share of the clouds others say that it stands as predicted."""
    boxes = torch.cat([unit_boxes(some @ frames)[0][:, :GALLERY_POINTS] for some in (clouds, closed)])
    every = rotation_group(24).elements.to(clouds)  # the identity comes first
    costs = []
    for number, frame in enumerate(announced(log, "boxes, compared with others", frames)):
        # A cloud and its copy are no others.
        others = torch.arange(len(boxes)) % len(clouds) != number
        some = clouds[number] if number % 2 else closed[number]
        costs.append(mean_of_nearest(distances_to_others(some, frame @ every, boxes[others])))
    cost = torch.stack(costs).log()
    likely = [(-weight * cost).log_softmax(dim=1)[:, 0] for weight in _WEIGHTS]
    doubt = math.log(_WRONG / len(every))
    score = torch.stack([torch.logaddexp(some + math.log1p(-_WRONG), torch.tensor(doubt)).mean() for some in likely])
    return float(_WEIGHTS[score.argmax()]), float((cost.argmin(dim=1) == 0).double().mean())
