"""What `inference.confidence` is learnt from: do predictions of a cloud, turned and sampled again, agree?

And do they, if it is stretched besides? Stretched along the axes of its base, an object stands as it stood and has the
same parts, but is unlike those of training, as are objects that these did not span.
"""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING, NamedTuple

import roma
import torch
from torch import Tensor

from articulate_ssl.geometry.se3 import se3, transform_points
from articulate_ssl.inference.confidence import relative_error
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.metrics.functional import ABOVE_DEG
from articulate_ssl.ops.farthest_point import farthest_point_order
from articulate_ssl.ops.progress import announced, tell

if TYPE_CHECKING:
    from articulate_ssl.training.module import ArticulatedPoseModule

_SAMPLED = 0.6  # share of a cloud's points that the second prediction is drawn from
# Upright cameras tilt, but not much: within an orientation range, clouds are turned by so much more. Chosen.
_TILT = math.radians(20)
_SAME_PARTS = 0.75  # share of the points that must stay in their part; a plate taken for another loses about half
_STRETCH = 2.0  # at most, either way, along each axis. Chosen.
_BATCH = 16

log = logging.getLogger(__name__)


def another_look(
    clouds: Tensor,  # [n, N, 3]
    limited: bool,  # whether objects are turned within a range
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:  # [n, .6 N, 3] farthest-point order, [n, 3, 3]
    """The same clouds, turned by random rotations, of a random part of their points; and those rotations."""
    if limited:
        direction = torch.nn.functional.normalize(torch.randn(len(clouds), 3, generator=generator), dim=1)
        turn = roma.rotvec_to_rotmat(direction * _TILT * torch.rand(len(clouds), 1, generator=generator))
    else:
        turn = roma.unitquat_to_rotmat(
            torch.nn.functional.normalize(torch.randn(len(clouds), 4, generator=generator), dim=1)
        )
    turn = turn.to(clouds)
    count = int(_SAMPLED * clouds.shape[1])
    kept = torch.rand(clouds.shape[:2], generator=generator).to(clouds).argsort(dim=1)[:, :count]
    sampled = clouds.gather(1, kept[..., None].expand(-1, -1, 3))
    order = [torch.from_numpy(farthest_point_order(cloud.cpu().numpy(), count)) for cloud in sampled]
    sampled = torch.stack([cloud[one.to(cloud.device)] for cloud, one in zip(sampled, order, strict=True)])
    return sampled @ turn.mT, turn


def agree(
    first: Prediction,
    second: Prediction,
    points: tuple[Tensor, Tensor],  # [B, N, 3] that they label
    turn: Tensor,  # [B, 3, 3] from the first to the second
) -> Tensor:  # [B] bool
    """Whether orientations agree within 30 degrees, and parts on three quarters of the points."""
    back = transform_points(se3(turn.mT, turn.new_zeros(len(turn), 3)), points[1])
    nearest = torch.cdist(back, points[0]).argmin(dim=-1)
    same = (first.part_id.gather(1, nearest) == second.part_id).float().mean(dim=1) > _SAME_PARTS
    angle = roma.rotmat_geodesic_distance(turn @ first.base_pose[:, :3, :3], second.base_pose[:, :3, :3])
    return same & (angle < math.radians(ABOVE_DEG))


def stretches(
    prediction: Prediction,
    points: Tensor,  # [B, N, 3] that it labels
    generator: torch.Generator,
) -> Tensor:  # [B, 3, 3] symmetric
    """Random stretches along the principal axes of each base's points, which leave the clouds as large as they are."""
    parts = prediction.num_parts
    base = parts * (parts - 1) // 2 - prediction.joint_child.sum(dim=1)  # the one that is no joint's child
    of_base = (prediction.part_id == base[:, None])[..., None]
    center = (points * of_base).sum(dim=1, keepdim=True) / of_base.sum(dim=1, keepdim=True).clamp(min=1)
    offset = (points - center) * of_base
    axes = torch.linalg.eigh(offset.mT @ offset).eigenvectors
    factor = _STRETCH ** (2 * torch.rand(len(points), 3, generator=generator) - 1).to(points)
    stretch = axes * factor[:, None] @ axes.mT
    size, stretched_size = (cloud.norm(dim=-1).mean(dim=1) for cloud in (points, points @ stretch))
    return stretch * (size / stretched_size)[:, None, None]


class Looks(NamedTuple):
    """Predictions of n clouds: relative errors, margins, and whether another look agrees; each [n]."""

    error: Tensor
    margin: Tensor
    agrees: Tensor


@torch.no_grad()
def look_again(
    module: ArticulatedPoseModule,
    clouds: Tensor,  # [n, N, 3] farthest-point order, dense
) -> tuple[Looks, Looks]:
    """At the clouds, turned and sampled again; and at the same, stretched besides."""
    generator, stretching = torch.Generator().manual_seed(0), torch.Generator().manual_seed(1)
    count = max(module.num_points, module.inference.points)
    found: tuple[list[Looks], list[Looks]] = [], []
    for some in announced(log, "learning confidence", clouds.split(_BATCH)):
        points = some[:, :count]
        first = module.predict_points(points, dense=some)
        second, seen, turn = _predict_again(module, some, count, generator)
        alike = agree(first, second, (points, seen), turn)
        found[0].append(Looks(relative_error(first, points), first.margin, alike))
        stretch = stretches(first, points, stretching)
        second, seen, turn = _predict_again(module, some @ stretch, count, stretching)
        alike = agree(first, second, (points @ stretch, seen), turn)
        found[1].append(Looks(relative_error(second, seen), second.margin, alike))
    plain, stretched = (Looks(*map(torch.cat, zip(*looks, strict=True))) for looks in found)
    told = int(plain.agrees.sum()), len(clouds), int(stretched.agrees.sum())
    tell(log, "%d of %d training clouds are predicted alike a second time, stretched %d", *told)
    return plain, stretched


def _predict_again(
    module: ArticulatedPoseModule,
    clouds: Tensor,  # [B, N, 3]
    count: int,
    generator: torch.Generator,
) -> tuple[Prediction, Tensor, Tensor]:
    """The prediction of another look at clouds, the points [B, count, 3] that it labels, and their turn [B, 3, 3]."""
    again, turn = another_look(clouds, module.orientation.limited, generator)
    return module.predict_points(again[:, :count], dense=again), again[:, :count], turn


def learn_confidence(
    module: ArticulatedPoseModule,
    clouds: Tensor,  # [n, N, 3] farthest-point order, dense
) -> None:
    """Find out how far predictions can be trusted."""
    plain, stretched = look_again(module, clouds)
    module.confidence.learn(*plain)
    module.confidence.learn_strangeness(*stretched)
