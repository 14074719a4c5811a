"""Which clouds are tried as the template, and which clouds they are compared with."""

from __future__ import annotations

import logging

import torch
from torch import Tensor

from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.discovery.registration import chamfer_l1, register_rigid
from articulate_ssl.discovery.synchronization import unit_boxes
from articulate_ssl.geometry.se3 import invert_se3, transform_points

_FEWEST_POINTS = 64  # of rigid alignment, however few points registration has otherwise
_ROUNDS = 20  # of moving medoids, at most

log = logging.getLogger(__name__)


def choose_references(clouds: Tensor, count: int) -> Tensor:
    """Indices of typical clouds that differ: medoids of clusters of the sorted distances to the centre.

    These are invariant to rotation, and tell an open object from a closed one.
    """
    return _medoids(_sorted_radii(clouds), count)


def choose_objects(
    clouds: Tensor,  # [n, N, 3]
    instance: Tensor,  # [n] which object each cloud shows
    count: int,
    fewest: int,
) -> Tensor:
    """Which objects are typical by the same measure, in the mean over their clouds, of those with `fewest` clouds."""
    objects, clouds_of = instance.unique(return_counts=True)
    objects = objects[clouds_of >= fewest]
    if not len(objects):
        return objects
    radii = _sorted_radii(clouds)
    means = torch.stack([radii[instance == one].mean(dim=0) for one in objects])
    return objects[_medoids(means, min(count, len(objects)))]


def evenly_chosen(rows: Tensor, most: int) -> Tensor:
    """At most so many of them, spread evenly."""
    return rows[torch.linspace(0, len(rows) - 1, min(len(rows), most)).round().long()]


def _sorted_radii(clouds: Tensor) -> Tensor:
    return (clouds - clouds.mean(dim=1, keepdim=True)).norm(dim=-1).sort(dim=1).values


def _medoids(radii: Tensor, count: int) -> Tensor:
    """Indices of the medoids of `count` clusters."""
    distance = torch.cdist(radii, radii, p=1)
    # The first is the most typical of all, the others are ever less so.
    medoids = distance.sum(dim=1).argsort()[torch.linspace(0, len(radii) - 1, count).long()]
    for _ in range(_ROUNDS):
        nearest = distance[medoids].argmin(dim=0)
        clusters = [(nearest == k).nonzero().squeeze(-1) for k in range(count)]
        moved = [
            c[distance[c][:, c].sum(dim=1).argmin()] if len(c) else m for c, m in zip(clusters, medoids, strict=True)
        ]
        if torch.equal(torch.stack(moved), medoids):
            break
        medoids = torch.stack(moved)
    return medoids.unique()


def aligned_to(
    reference: Tensor,  # [N, 3]
    clouds: Tensor,  # [n, N, 3]
    rotations: Tensor,  # [H, 3, 3] starts
    options: DiscoveryOptions,
) -> Tensor:  # [split_clouds, N, 3]
    """The clouds to which the reference, taken as one rigid part, fits best, in its frame."""
    coarse = max(_FEWEST_POINTS, options.points // 2)
    rigid, error = register_rigid(reference[:coarse], clouds[:, :coarse], rotations, keep=1)
    log.info("rigid alignment: median Chamfer-L1 %.4f", error[:, 0].median())
    best = error[:, 0].argsort()[: options.split_clouds]
    return transform_points(invert_se3(rigid[best, 0]), clouds[best])


def alike(
    reference: Tensor,  # [N, 3]
    clouds: Tensor,  # [n, N, 3] in a frame they have in common
    options: DiscoveryOptions,
) -> Tensor:  # [split_clouds, N, 3]
    """The clouds that are most like the reference when both are stretched to unit boxes.

    What slides shows best between objects of like proportions.
    """
    boxes = unit_boxes(torch.cat([reference[None], clouds]))[0][:, : options.points]
    distance = chamfer_l1(boxes[1:], boxes[:1].expand(len(clouds), -1, -1))
    return clouds[distance.argsort()[: options.split_clouds]]
