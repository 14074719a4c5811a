"""Pieces of a template as free bodies: each registered to every cloud on its own, with no joints between them."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from articulate_ssl.discovery.instance_fit import smooth_labels
from articulate_ssl.discovery.proposals import Scene, Split
from articulate_ssl.discovery.registered_shape import trimmed_mean
from articulate_ssl.discovery.registration import chamfer_l1, update_poses
from articulate_ssl.geometry.se3 import transform_points
from articulate_ssl.shape.articulated_shape import ArticulatedShape

_SCALES = torch.logspace(-1.1, -1.7, 16).tolist()  # of the correspondences, .08 to .02, a round each
_RELABEL_EVERY = 2  # rounds
_CAP = 4  # scales: distances beyond count as this when points are given to pieces


class Bodies(NamedTuple):
    """Pieces without joints, and where each is in every cloud."""

    shape: ArticulatedShape
    pose: Tensor  # [n, K, 4, 4] template -> cloud


def fit_bodies(splits: list[Split], scene: Scene) -> list[Bodies]:
    """Bodies of all splits that keep their parts; of the refined ones, which are many, those that fit best."""
    options, thin = scene.options, scene.thin
    refined, as_proposed = [], []
    for split in splits:
        bodies = moving_bodies(scene.template, split, scene.num_parts, thin)
        if bodies.shape.smallest_share < options.min_share:
            continue
        if split.refined:
            error = chamfer_l1(thin, bodies.shape.moved(bodies.pose))
            refined.append((trimmed_mean(error, options), bodies))
        else:
            as_proposed.append(bodies)
    best = sorted(refined, key=lambda candidate: candidate[0])[: options.jointed]
    return [bodies for _, bodies in best] + as_proposed


def moving_bodies(
    template: Tensor,  # [T, 3]
    split: Split,
    num_parts: int,
    clouds: Tensor,  # [n, N, 3] aligned
) -> Bodies:
    """Register the pieces to the clouds; if the split is to be refined, give points to the pieces meanwhile."""
    shape = ArticulatedShape.unjointed(template, split.label, num_parts)
    pose = torch.eye(4).to(template).expand(len(clouds), num_parts, 4, 4)
    for step, scale in enumerate(_SCALES):
        pose = update_poses(shape.thinned(clouds.shape[1]), pose, clouds, scale)
        if split.refined and step % _RELABEL_EVERY == _RELABEL_EVERY - 1:
            shape = relabel(shape, pose, clouds, cap=_CAP * scale)
    return Bodies(shape, pose)


def relabel(
    shape: ArticulatedShape,
    pose: Tensor,  # [n, K, 4, 4]
    clouds: Tensor,  # [n, N, 3]
    cap: float,  # distances beyond this count as this
) -> ArticulatedShape:
    """Give every point to the part whose motion brings it closest to the clouds, smoothed over neighbours."""
    cost = shape.points.new_zeros(len(shape.points), shape.num_parts)
    for part in range(shape.num_parts):
        moved = transform_points(pose[:, part], shape.points)  # [n, T, 3]
        for cloud, points in zip(clouds.split(32), moved.split(32), strict=True):
            cost[:, part] += torch.cdist(points, cloud).amin(dim=2).clamp(max=cap).sum(dim=0)
    return replace(shape, label=smooth_labels(shape.points, cost))
