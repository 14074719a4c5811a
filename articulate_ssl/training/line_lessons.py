"""How the category's joint lines are corrected by predictions of training clouds: parts touch them (`touching_lines`).

Once more from where that leads, as better lines say better which part points are of.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from articulate_ssl.inference.touching_lines import shifts_to_touch
from articulate_ssl.network.hypotheses import Hypotheses, concatenated
from articulate_ssl.ops.progress import announced, tell
from articulate_ssl.training.explanations import registered_points

if TYPE_CHECKING:
    from articulate_ssl.training.module import ArticulatedPoseModule

_BATCH = 16
_ROUNDS = 3  # at most, of moving lines. Chosen.

log = logging.getLogger(__name__)


@torch.no_grad()
def learn_joint_lines(
    module: ArticulatedPoseModule,
    explained: Hypotheses,  # H = 1, of n clouds
    clouds: Tensor,  # [n, N, 3] farthest-point order, dense
) -> Hypotheses:  # H = 1
    """Move the category's joint lines to where both of their parts are.

    Returns:
        Clouds explained by the category as it is then.
    """
    estimator, points = module.estimator, clouds[:, : registered_points(module)]
    for _ in range(_ROUNDS):
        fitted = estimator.final.in_proportion(explained, points, clouds)
        shifts, apart = shifts_to_touch(fitted, clouds)
        if not shifts.any():
            break
        for joint, (before, after) in enumerate(apart.tolist()):
            moved, far = shifts[joint].norm(), (before, after)
            tell(log, "joint %d: line moved by %.2f, parts are %.3f from it, before %.3f", joint, moved, *reversed(far))
        module.articulated.category.move_lines(shifts, explained.state[:, 0].median(dim=0).values)
        explained = explain(module, clouds, "joint lines")
    return explained


@torch.no_grad()
def explain(module: ArticulatedPoseModule, clouds: Tensor, work: str) -> Hypotheses:  # H = 1
    """Training clouds as the estimator explains them, before they take their proportions; by batches.

    Args:
        work: What progress is called.
    """
    count = registered_points(module)
    return concatenated(
        [
            module.estimator.explained(some[:, :count], module.num_points, some)
            for some in announced(log, work, clouds.split(_BATCH))
        ]
    )
