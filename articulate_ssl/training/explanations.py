"""What `inference.two_ways` and `handedness` are learnt from: training clouds that can be explained in two ways.

No label is read.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from articulate_ssl.inference.prediction import Prediction, concatenate
from articulate_ssl.inference.surface_decision import SurfaceDecision
from articulate_ssl.inference.swapped_parts import PartViews
from articulate_ssl.inference.two_ways import FEWEST
from articulate_ssl.ops.progress import announced, tell
from articulate_ssl.shape.object_axes import object_axes
from articulate_ssl.training.near_lessons import learn_from_near
from articulate_ssl.training.surface_lessons import learn_surface

if TYPE_CHECKING:
    from articulate_ssl.training.module import ArticulatedPoseModule

_BATCH = 16
# Standard deviation of the noise, at most: a hundredth of the object's diagonal, that of a scanner of small things.
# Of unseen laptops' clouds with noise of .02, 16.7 % were turned over without it, 14.2 % with it (step 86 of the log).
_NOISE = 0.01
# Share of the clouds that a network was not taught by, of which it must say what the teacher says. Relief: those that
# it is not sure of, of which half is chance. Fits: clouds drawn at random; where more than one in ten is said to be
# wrong, nobody knows who is. Both chosen.
_UNSURE_AGREE, _FITS_AGREE = 0.6, 0.9
_RELATED = 208  # clouds that show whether, and how, two explanations are related: that takes fewer than the decision

log = logging.getLogger(__name__)


@torch.no_grad()
def learn_two_ways(
    module: ArticulatedPoseModule,
    clouds: Tensor,  # [n, N, 3] farthest-point order, dense
) -> None:
    """Find out whether rivals are alike in all clouds; if so, tell the two apart by the relief of both.

    Either way, a network is taught by what decides so far, relief or fits.
    """
    if len(clouds) < FEWEST:
        tell(
            log, "no decision between two explanations: it takes %d training clouds, there are %d", FEWEST, len(clouds)
        )
        return
    two_ways = module.estimator.two_ways
    two_ways.surface = two_ways.near = None  # of a run that ended and goes on
    chosen, rival = _with_rivals(module, clouds[:_RELATED], "two explanations, their relation")
    if two_ways.learn_twin(_object_poses(chosen), _object_poses(rival), chosen.margin):
        _learn_from_relief(module, clouds)
    else:
        tell(log, "the collection has no say in which explanation is right: fits differ, or rivals from cloud to cloud")
        _learn_from_fits(module, clouds, chosen, rival)


def _learn_from_relief(module: ArticulatedPoseModule, clouds: Tensor) -> None:
    """The decision between twins."""
    estimator, generator = module.estimator, torch.Generator().manual_seed(0)
    found, noisy_clouds = [], []
    for some in announced(log, "two explanations, their relief", clouds.split(_BATCH)):
        noisy_clouds.append(with_noise(some, generator))
        points = some[:, : registered_points(module)]
        found.append(estimator.both_ways(points, module.num_points, (some, noisy_clouds[-1])))
    frames, reliefs, views = zip(*found, strict=True)
    clean, noisy = ([torch.cat(each) for each in zip(*some, strict=True)] for some in zip(*reliefs, strict=True))
    two_ways = estimator.two_ways
    if not two_ways.learn_decision(clean, noisy):
        log.warning("too few clouds show all parts in both explanations: none is decided")
        return
    odds, frames = two_ways.relief_odds(*clean), torch.cat(frames)
    favoured = torch.where((odds > 0)[:, None, None, None], frames, frames.flip(1))
    clearest = odds.abs().argsort(descending=True)[: int((odds != 0).sum())]
    two_ways.surface = learn_surface((clouds, torch.cat(noisy_clouds)), favoured, clearest, _UNSURE_AGREE)
    if views[0] is not None:
        whole = torch.zeros_like(odds) if two_ways.surface is None else _odds(two_ways.surface, frames, clouds)
        two_ways.near = learn_from_near(PartViews.concatenate(views), odds > 0, whole, clearest, _UNSURE_AGREE)


def _odds(network: SurfaceDecision, frames: Tensor, clouds: Tensor) -> Tensor:  # [n]
    """Of explanations, and not their twins."""
    shown = zip(frames.split(_BATCH), clouds.split(_BATCH), strict=True)
    return torch.cat([network.log_odds(*some) for some in shown])


def _learn_from_fits(module: ArticulatedPoseModule, clouds: Tensor, chosen: Prediction, rival: Prediction) -> None:
    """The decision between predictions, of the leading clouds those that are given, and their rivals."""
    generator = torch.Generator().manual_seed(0)
    found = [(chosen, rival)]
    if len(clouds) > _RELATED:
        found.append(_with_rivals(module, clouds[_RELATED:], "predictions and their rivals"))
    frames = torch.stack([torch.cat([one.base_pose[:, :3, :3] for one in some]) for some in zip(*found, strict=True)])
    frames = frames.transpose(0, 1)
    rivalled = (frames[:, 0] != frames[:, 1]).flatten(1).any(dim=1).nonzero()[:, 0]
    order = rivalled[torch.randperm(len(rivalled), generator=generator).to(rivalled.device)]
    noisy = torch.cat([with_noise(some, generator) for some in clouds.split(_BATCH)])
    module.estimator.two_ways.surface = learn_surface((clouds, noisy), frames, order, _FITS_AGREE)


def _with_rivals(module: ArticulatedPoseModule, clouds: Tensor, work: str) -> tuple[Prediction, Prediction]:
    """Predictions and their rivals, no decision made."""
    shown = announced(log, work, clouds.split(_BATCH))
    points = registered_points(module)
    estimator, count = module.estimator, module.num_points
    found = [estimator.predict_with_rivals(some[:, :points], count, fits=False) for some in shown]
    return tuple(concatenate(list(several)) for several in zip(*found, strict=True))


def registered_points(module: ArticulatedPoseModule) -> int:
    """How many leading points of a cloud are registered."""
    return max(module.num_points, module.inference.points)


@torch.no_grad()
def learn_handedness(
    module: ArticulatedPoseModule,
    clouds: Tensor,  # [n, N, 3] farthest-point order, of an upright camera
) -> None:
    """Find out whether some objects are mirror images of the others."""
    estimator, network, count = module.estimator, module.articulated, registered_points(module)
    shown = announced(log, "mirror images", clouds.split(_BATCH))
    errors = [estimator.mirror_errors(some[:, :count], module.num_points) for some in shown]
    axes = object_axes(network.category.articulated_shape(network.joint_type))
    estimator.handedness.learn(*(torch.cat(several) for several in zip(*errors, strict=True)), axes)


def with_noise(clouds: Tensor, generator: torch.Generator) -> Tensor:
    """Clouds [B, P, 3] with noise, each of its own standard deviation."""
    sigma = _NOISE * torch.rand(len(clouds), 1, 1, generator=generator)
    return clouds + (sigma * torch.randn(clouds.shape, generator=generator)).to(clouds)


def _object_poses(prediction: Prediction) -> Tensor:
    """[n, K, 4, 4] canonical object space -> cloud."""
    pose = prediction.part_pose.clone()
    pose[..., :3, 3] -= (pose[..., :3, :3] @ prediction.assembly[..., None]).squeeze(-1)
    return pose
