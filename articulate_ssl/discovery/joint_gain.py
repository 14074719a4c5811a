"""What joints explain: how much worse clouds are reconstructed when one of them stands still.

Of two templates the more typical object reconstructs better, whether its parts are right or not: the halves of a wrong
split, stretched, explain a collection of ovens better than the right door of an odd one. The same template with a joint
at rest is as typical, and its parts stretch as freely; what it loses is the joint's own.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import torch
from torch import Tensor

from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.discovery.registered_shape import RegisteredShape, trimmed_mean

log = logging.getLogger(__name__)


def best_by_joints(
    candidates: list[RegisteredShape],
    clouds: Tensor,  # [n, N, 3] that they are all registered to
    options: DiscoveryOptions,
) -> RegisteredShape:
    """The one of the smallest error, of which what its joints explain is taken off once more."""
    if len(candidates) == 1:
        return candidates[0]
    scores = []
    for number, found in enumerate(candidates, start=1):
        error = trimmed_mean(found.error, options)
        gain = joint_gain(found, clouds, options)
        log.info("template %d of %d: error %.4f, joints explain %.4f", number, len(candidates), error, gain)
        scores.append(error - gain)
    return candidates[scores.index(min(scores))]


def joint_gain(
    found: RegisteredShape,
    clouds: Tensor,  # [n, N, 3] that it is registered to
    options: DiscoveryOptions,
) -> float:
    """By how much the reconstruction error grows when a joint stands still, of the joint that matters least.

    Pose, stretch and the other joints descend again from where they are, on the same points as they do with all joints
    free. The clouds that are reconstructed worst do not count: where the pose is wrong, a joint says nothing.
    """
    best = found.error.argsort()[: options.kept(len(clouds))]
    found, clouds = found.of_clouds(best), clouds[best]
    free = _error(found, clouds, options)
    still = []
    for joint, middle in enumerate(found.state.median(dim=0).values):
        state = found.state.clone()
        state[:, joint] = middle
        limits = torch.stack([state.amin(dim=0), state.amax(dim=0)], dim=-1)
        shape = replace(found.shape, joints=replace(found.shape.joints, limits=limits))
        still.append(_error(replace(found, shape=shape, state=state), clouds, options))
    return min(still) - free


def _error(found: RegisteredShape, clouds: Tensor, options: DiscoveryOptions) -> float:
    fit = found.fit(torch.Generator().manual_seed(options.seed))
    fit.optimise(clouds, options.cycles, shared=False)
    return float(fit.error(clouds, softened=False).mean())
