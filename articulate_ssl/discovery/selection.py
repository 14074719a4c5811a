"""Which of many fits explains the clouds best: heats of descent, each longer than the last and with fewer fits."""

from __future__ import annotations

import logging

import torch
from torch import Tensor

from articulate_ssl.discovery.edge_hinges import hinged_at_edges
from articulate_ssl.discovery.instance_fit import InstanceFit
from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.discovery.registered_shape import trimmed_mean
from articulate_ssl.geometry.screw import REVOLUTE

log = logging.getLogger(__name__)

# Chosen by hand, not measured: the longer the descent, the fewer fits it can be paid for.
_AFTER_SHORT_DESCENT, _AFTER_MEDIUM_DESCENT = 8, 3
_STILL = 0.01  # in normalised units: what moves less is not a part


def select(fits: list[InstanceFit], clouds: Tensor, options: DiscoveryOptions) -> InstanceFit | None:
    """The fit that reconstructs the clouds best; None if in every one a part is lost or does not move."""
    fits = descended(fits, clouds, options.few_cycles, options)[:_AFTER_SHORT_DESCENT]
    fits = descended(fits, clouds, max(1, options.cycles // 2), options)[:_AFTER_MEDIUM_DESCENT]
    if options.edge_hinges:
        fits += [other for fit in fits for other in hinged_at_edges(fit)]
        fits = descended(fits, clouds, options.few_cycles, options)[:_AFTER_MEDIUM_DESCENT]
    fits = descended(fits, clouds, options.cycles, options)
    return fits[0] if fits else None


def descended(fits: list[InstanceFit], clouds: Tensor, cycles: int, options: DiscoveryOptions) -> list[InstanceFit]:
    """Those whose parts are all there and still move after a descent, best first."""
    log.info("descent on %d splits", len(fits))
    for fit in fits:
        fit.optimise(clouds, cycles, keep=options.keep)
    moving = [fit for fit in fits if fit.shape.smallest_share >= options.min_share and least_motion(fit) > _STILL]
    return sorted(moving, key=lambda fit: trimmed_mean(fit.error(clouds), options))


def least_motion(fit: InstanceFit) -> float:
    """Standard deviation over the clouds of how far a joint moves the part on it, of the joint that moves least."""
    shape, spread = fit.shape, fit.state.std(dim=0)
    joints = shape.joints
    if joints.joint_type == REVOLUTE:
        for j, child in enumerate(joints.chain.child):
            offset = shape.part(child) - joints.pivot[j]
            spread[j] *= torch.linalg.cross(offset, joints.axis[j].expand_as(offset)).norm(dim=1).mean()
    return float(spread.min())
