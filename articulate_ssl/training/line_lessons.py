"""How the category's joint lines are corrected by predictions of training clouds.

Parts touch them (`touching_lines`); once more from where that leads, as better lines say better which part points are
of. And hinges are mostly parallel to an edge of what they are on: where the faces of parts say nothing, one that is
nearly parallel to a principal direction of the body, and farther from it than that is uncertain, becomes so.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn import functional

from articulate_ssl.geometry.se3 import invert_se3, transform_points
from articulate_ssl.inference.touching_lines import shifts_to_touch
from articulate_ssl.losses.reconstruction import distances_to_parts
from articulate_ssl.network.hypotheses import Hypotheses, concatenated
from articulate_ssl.ops.progress import announced, tell
from articulate_ssl.shape.articulated_shape import MIN_POINTS
from articulate_ssl.shape.stretch import principal_directions
from articulate_ssl.training.explanations import registered_points

if TYPE_CHECKING:
    from articulate_ssl.training.module import ArticulatedPoseModule

_BATCH = 16
_ROUNDS = 3  # at most, of moving lines. Chosen.
# Degrees. How far a joint is from a principal direction of the body for that to take its place: less is no news, as
# directions are off by one themselves, more is no coincidence (docs/experiments.md, step 191). And how much directions
# may differ from cloud to cloud, in the median; those of a lamp's round foot differ by 27. Chosen.
_OFF, _ALIKE = (3.0, 6.0), 3.0

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
        shifts, apart = shifts_to_touch(fitted, clouds, module.orientation.limited)
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


@torch.no_grad()
def learn_joint_axes(
    module: ArticulatedPoseModule,
    explained: Hypotheses,  # H = 1, of n clouds
    clouds: Tensor,  # [n, N, 3] farthest-point order, dense
) -> bool:
    """Turn the category's joint lines on the body to its principal directions, if they nearly are.

    Returns:
        Whether any was turned.
    """
    fitted = module.estimator.final.in_proportion(explained, clouds[:, : registered_points(module)], clouds)
    part = torch.cat([distances_to_parts(*some).argmin(-1) for some in _batches(clouds, fitted.posed()[:, 0])])
    seen, root = transform_points(invert_se3(fitted.base[:, 0]), clouds), fitted.chain.root
    bodies = [cloud[own == root] for cloud, own in zip(seen, part, strict=True)]
    known = [principal_directions(body) for body in bodies if len(body) >= MIN_POINTS]
    if not known:
        return False
    principal = torch.stack(known)
    axes, turned = fitted.axis[:, 0].mean(dim=0), False
    for joint, parent in enumerate(fitted.chain.parent):
        axis = functional.normalize(axes[joint], dim=0)
        axes[joint] = axis
        direction, apart = _principal_along(axis, principal)
        off = (axis @ direction).clamp(max=1).acos().rad2deg()
        if parent == root and apart < _ALIKE and _OFF[0] < off < _OFF[1]:
            tell(log, "joint %d: turned by %.1f degrees, to be parallel to the body", joint, off)
            axes[joint], turned = direction, True
    if turned:
        module.articulated.category.turn_lines(axes)
    return turned


def _principal_along(
    axis: Tensor,  # [3] unit
    principal: Tensor,  # [n, 3, 3] columns
) -> tuple[Tensor, Tensor]:  # [3] unit, []
    """The mean of those principal directions that are nearest to an axis, and how far they are from it, in degrees."""
    cosine = axis @ principal
    nearest = cosine.abs().argmax(dim=-1, keepdim=True)
    along = principal.gather(2, nearest[:, None].expand(-1, 3, -1)).squeeze(2)
    along = along * cosine.gather(1, nearest).sign()
    mean = functional.normalize(along.mean(dim=0), dim=0)
    return mean, (along @ mean).clamp(max=1).acos().rad2deg().median()


def _batches(*values: Tensor) -> zip:
    return zip(*(value.split(_BATCH) for value in values), strict=True)
