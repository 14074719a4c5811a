"""Templates that agree about the collection: right splits are alike, and every wrong one is wrong in its own way.

Where one template takes the lid of half of the laptops for their base, others do not.
"""

from __future__ import annotations

import logging
import math

import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.geometry.se3 import transform_points
from articulate_ssl.ops.chamfer import nearest_distance

_POINTS = 512  # of a cloud that are compared

log = logging.getLogger(__name__)


def agreeing(
    candidates: list[RegisteredShape],
    clouds: Tensor,  # [n, N, 3] that they are all registered to
) -> list[RegisteredShape]:
    """The half that agrees most with all others about which points of the clouds belong together; two are kept both."""
    if len(candidates) <= 2:
        return candidates
    labels = [part_labels(found, clouds[:, :_POINTS]) for found in candidates]
    parts = candidates[0].shape.num_parts
    share = torch.tensor([[agreement(one, other, parts) for other in labels] for one in labels])
    with_others = (share.sum(dim=1) - 1) / (len(candidates) - 1)
    log.info("templates agree with the others about %s of the points", [round(x, 2) for x in with_others.tolist()])
    kept = with_others.topk(math.ceil(len(candidates) / 2)).indices.sort().values
    return [candidates[k] for k in kept.tolist()]


def part_labels(
    found: RegisteredShape,
    clouds: Tensor,  # [n, N, 3]
) -> Tensor:  # [n, N] int64
    """Of every point the part that has the nearest point of the shape where it lies in the cloud."""
    shape = found.shape
    pose = shape.joints.part_pose(found.base, found.state)  # [n, K, 4, 4]
    distance = [
        nearest_distance(clouds, transform_points(pose[:, k], shape.part(k).expand(len(clouds), -1, -1)))
        for k in range(shape.num_parts)
    ]
    return torch.stack(distance, dim=-1).argmin(dim=-1)


def agreement(
    one: Tensor,  # [n, N] parts of points
    other: Tensor,  # [n, N]
    num_parts: int,
) -> float:
    """Share of the points that are of the same part, whatever it is called."""
    return float((renaming(one, other, num_parts)[one] == other).float().mean())


def renaming(
    one: Tensor,  # parts of points, of any shape
    other: Tensor,  # of the same points
    num_parts: int,
) -> Tensor:  # [K] int64
    """What `other` calls the parts of `one`, each another name, so that most points are called alike."""
    both = torch.bincount((num_parts * one + other).flatten(), minlength=num_parts**2).view(num_parts, num_parts)
    return torch.from_numpy(linear_sum_assignment(both.cpu().numpy(), maximize=True)[1]).to(one.device)
