"""What `inference.confidence` is learnt from: do predictions of a cloud, turned and sampled again, agree?"""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING

import roma
import torch
from lightning.pytorch import Callback
from torch import Tensor

from articulate_ssl.geometry.se3 import se3, transform_points
from articulate_ssl.inference.confidence import relative_error
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.metrics.functional import ABOVE_DEG
from articulate_ssl.ops.farthest_point import farthest_point_order
from articulate_ssl.ops.progress import announced, tell
from articulate_ssl.training.set_clouds import SetClouds

if TYPE_CHECKING:
    from articulate_ssl.training.module import ArticulatedPoseModule

_SAMPLED = 0.6  # share of a cloud's points that the second prediction is drawn from
# Upright cameras tilt, but not much: within an orientation range, clouds are turned by so much more. Chosen.
_TILT = math.radians(20)
_SAME_PARTS = 0.75  # share of the points that must stay in their part; a plate taken for another loses about half
_BATCH = 16

log = logging.getLogger(__name__)


class LearnConfidence(Callback):
    """Let a module learn its confidence after its last step, before that step's checkpoint is written."""

    def on_train_batch_end(self, trainer, pl_module: ArticulatedPoseModule, *_) -> None:
        """At the last step only."""
        if trainer.global_step == trainer.max_steps and pl_module.calibration_samples:
            pl_module.learn_what_predictions_are_worth(SetClouds(trainer.datamodule))


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


@torch.no_grad()
def look_twice(
    module: ArticulatedPoseModule,
    clouds: Tensor,  # [n, N, 3] farthest-point order, dense
) -> tuple[Tensor, Tensor, Tensor]:  # [n] each
    """Relative errors and margins of the clouds' predictions, and whether a second look agrees."""
    generator = torch.Generator().manual_seed(0)
    count = max(module.num_points, module.inference.points)
    found = []
    for some in announced(log, "learning confidence", clouds.split(_BATCH)):
        again, turn = another_look(some, module.orientation.limited, generator)
        points = some[:, :count], again[:, :count]
        first, second = (module.predict_points(p, dense=whole) for p, whole in zip(points, (some, again), strict=True))
        found.append((relative_error(first, points[0]), first.margin, agree(first, second, points, turn)))
    error, margin, agrees = (torch.cat(values) for values in zip(*found, strict=True))
    tell(log, "%d of %d training clouds are predicted alike a second time", int(agrees.sum()), len(agrees))
    return error, margin, agrees


def learn_confidence(
    module: ArticulatedPoseModule,
    clouds: Tensor,  # [n, N, 3] farthest-point order, dense
) -> None:
    """Find out how far predictions can be trusted."""
    module.confidence.learn(*look_twice(module, clouds))
