"""Restless points: those whose distance to the clouds varies most when nothing but the whole can move and stretch."""

from __future__ import annotations

import torch
from torch import Tensor

from articulate_ssl.discovery.instance_fit import InstanceFit
from articulate_ssl.discovery.proposals import Scene, Split
from articulate_ssl.discovery.proposals.random_cuts import cut_off
from articulate_ssl.ops.chamfer import nearest_squared_distance
from articulate_ssl.shape.articulated_shape import ArticulatedShape

_SHARES = (0.08, 0.15, 0.3)  # of the template's points
_SMOOTHING = 24  # points over which unrest is averaged


def propose(scene: Scene) -> list[Split]:
    """The most restless points are parts, for several shares of the template."""
    unrest = measure_unrest(scene.template, scene.aligned, scene.options.few_cycles, scene.generator)
    return [
        Split(cut_off(scene.template, unrest, share, scene.num_parts, scene.generator), refined=False)
        for share in _SHARES
    ]


def measure_unrest(
    template: Tensor,  # [T, 3]
    aligned: Tensor,  # [n, N, 3]
    cycles: int,
    generator: torch.Generator,
) -> Tensor:  # [T]
    """Standard deviation, over the clouds, of the distance of every template point and its neighbours to the cloud."""
    pose = torch.eye(4).to(template).expand(len(aligned), 4, 4)
    whole = ArticulatedShape.rigid(template)
    fit = InstanceFit(whole, pose, template.new_zeros(len(aligned), 0), generator)
    fit.optimise(aligned, cycles, shared=False)
    unrest = nearest_squared_distance(fit.posed(), aligned).sqrt().std(dim=0)
    near = torch.cdist(template, template).topk(min(_SMOOTHING, len(template)), largest=False).indices
    return unrest[near].mean(dim=1)
