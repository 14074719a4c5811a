"""What `inference.two_ways` and `handedness` are learnt from: training clouds that can be explained in two ways.

No label is read.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from articulate_ssl.inference.prediction import Prediction, concatenate
from articulate_ssl.inference.two_ways import FEWEST
from articulate_ssl.ops.progress import announced
from articulate_ssl.shape.object_axes import object_axes
from articulate_ssl.training.surface_lessons import learn_surface

if TYPE_CHECKING:
    from articulate_ssl.training.module import ArticulatedPoseModule

_BATCH = 16
# Standard deviation of the noise, at most: a hundredth of the object's diagonal, that of a scanner of small things.
# Of unseen laptops' clouds with noise of .02, 16.7 % were turned over without it, 14.2 % with it (step 86 of the log).
_NOISE = 0.01
_RELATED = 208  # clouds that show whether, and how, two explanations are related: that takes fewer than the decision

log = logging.getLogger(__name__)


@torch.no_grad()
def learn_two_ways(
    module: ArticulatedPoseModule,
    clouds: Tensor,  # [n, N, 3] farthest-point order, dense
) -> None:
    """Find out whether rivals are alike in all clouds; if so, tell the two apart by the relief of both."""
    if len(clouds) < FEWEST:
        log.info("no decision between two explanations: it takes %d training clouds, there are %d", FEWEST, len(clouds))
        return
    estimator, count = module.estimator, max(module.num_points, module.inference.points)
    shown = announced(log, "two explanations, their relation", clouds[:_RELATED].split(_BATCH))
    found = [estimator.predict_with_rivals(some[:, :count], module.num_points) for some in shown]
    chosen, rival = (concatenate(list(several)) for several in zip(*found, strict=True))
    if not estimator.two_ways.learn_twin(_object_poses(chosen), _object_poses(rival), chosen.margin):
        log.info("no decision between two explanations: fits tell them apart, or rivals differ from cloud to cloud")
        return
    shown = announced(log, "two explanations, their relief", clouds.split(_BATCH))
    generator = torch.Generator().manual_seed(0)
    frames, reliefs, noisy_clouds = [], [], []
    for some in shown:
        noisy_clouds.append(_noisy(some, generator))
        both, described = estimator.reliefs(some[:, :count], module.num_points, (some, noisy_clouds[-1]))
        frames.append(both)
        reliefs.append(described)
    clean, noisy = ([torch.cat(each) for each in zip(*some, strict=True)] for some in zip(*reliefs, strict=True))
    two_ways = estimator.two_ways
    if not two_ways.learn_decision(clean, noisy):
        log.warning("too few clouds show all parts in both explanations: none is decided")
        return
    two_ways.surface = learn_surface((clouds, torch.cat(noisy_clouds)), torch.cat(frames), two_ways.relief_odds(*clean))


@torch.no_grad()
def learn_handedness(
    module: ArticulatedPoseModule,
    clouds: Tensor,  # [n, N, 3] farthest-point order, of an upright camera
) -> None:
    """Find out whether some objects are mirror images of the others."""
    estimator, network, count = module.estimator, module.articulated, max(module.num_points, module.inference.points)
    shown = announced(log, "mirror images", clouds.split(_BATCH))
    errors = [estimator.mirror_errors(some[:, :count], module.num_points) for some in shown]
    axes = object_axes(network.category.articulated_shape(network.joint_type))
    estimator.handedness.learn(*(torch.cat(several) for several in zip(*errors, strict=True)), axes)


def _noisy(clouds: Tensor, generator: torch.Generator) -> Tensor:
    """Clouds [B, P, 3] with noise, each of its own standard deviation."""
    sigma = _NOISE * torch.rand(len(clouds), 1, 1, generator=generator)
    return clouds + (sigma * torch.randn(clouds.shape, generator=generator)).to(clouds)


def _object_poses(prediction: Prediction) -> Tensor:
    """[n, K, 4, 4] canonical object space -> cloud."""
    pose = prediction.part_pose.clone()
    pose[..., :3, 3] -= (pose[..., :3, :3] @ prediction.assembly[..., None]).squeeze(-1)
    return pose
