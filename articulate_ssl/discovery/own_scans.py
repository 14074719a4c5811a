"""Scans whose hinges and parts are those of their own object, as its other scans show them, and not the category's.

A shape that is registered to an object of other proportions has its hinge a few hundredths off, and names the part of
a point by what is nearest. Doors that are closed about such a hinge stand before their box, or within it, and leave
pieces behind (docs/experiments.md, step 302). But a few scans of one object in several states say exactly what moves,
and about which line: each is registered as the category's shape is, and then `one_object.refined`, with what the shape
says of their points as votes. No label is read; which scans show the same object is known here.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from articulate_ssl.discovery.collection import Collection
from articulate_ssl.discovery.discover import DiscoveryError
from articulate_ssl.discovery.one_object.adjustment import Placed
from articulate_ssl.discovery.one_object.find import OneObject, refined
from articulate_ssl.discovery.one_object.surface import Surface
from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.discovery.references import evenly_chosen
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.discovery.reshaping import instance_joints, point_parts
from articulate_ssl.geometry.se3 import rotation_between, se3
from articulate_ssl.ops.chamfer import nearest_index
from articulate_ssl.ops.denormals import flush_denormals
from articulate_ssl.ops.progress import announced
from articulate_ssl.shape.observation import Observation

# Of an object besides the one that is looked at. With four, hinges of eleven safes were at most 8 thousandths off, with
# three 9, in two thirds of the time.
_OTHERS = 3
_VOTE = 0.95  # for the part that the shape says a point is of. Chosen.
_FUSED = 64  # points of each part, of which nothing is made here
_NEIGHBOURS = 12  # of a point, with itself, that say which part it is of. Chosen.
_SAME = 1e-4  # by which the distances of a scan's points to their middle differ, however it is turned

log = logging.getLogger(__name__)


@flush_denormals()
def by_own_scans(
    found: RegisteredShape,  # with one revolute joint, registered to the clouds
    clouds: Tensor,  # [n, P, 3]
    instance: Tensor,  # [n] which object each shows; -1 if that is not known
    scans: Tensor,  # [m, P, 3] the same of whole objects, those of one object in one scale, the clouds among them
    of_object: Tensor,  # [m] which object each shows
    options: DiscoveryOptions,
) -> RegisteredShape:
    """The same, with clouds' own `point_part`, and bases that bring the shape's hinge to where the cloud's own is.

    So the body of the shape lies as far off as its hinge did. A cloud keeps what the registration says if its object
    was scanned in too few states, or if what its scans show is not explained.
    """
    joints, part = instance_joints(found), point_parts(found, clouds)
    base, state, own_part = found.base.clone(), found.state.clone(), part.clone()
    registrar = Collection.of(clouds, found.shape.joints.joint_type, options, Observation()).registrar
    known = (instance >= 0).nonzero()[:, 0].tolist()
    kept = 0
    for row in announced(log, "hinges of scans, by others of their objects", known):
        others = evenly_chosen((of_object == instance[row]).nonzero()[:, 0], _OTHERS + 1)
        others = others[~_same_scan(clouds[row], scans[others])][:_OTHERS]
        if len(others) < _OTHERS:
            continue
        together = torch.cat([clouds[row, None], scans[others]])
        placed = registrar.register(found, scans[others, : options.dense_points])
        votes = _votes(found, row, placed, together, part[row])
        pivot = torch.cat([joints.pivot[row, None], instance_joints(placed).pivot]).median(dim=0).values
        hinge = replace(found.shape.joints, axis=joints.axis[row].double(), pivot=pivot.double())
        start = torch.cat([found.base[row, None], placed.base]), torch.cat([found.state[row, None], placed.state])
        surfaces = [Surface.of(cloud) for cloud in together.double().numpy()]
        try:
            one = refined(surfaces, Placed(hinge, *(x.double() for x in start)), _FUSED, votes)
        except DiscoveryError:
            continue
        if not one.explained:
            continue
        base[row], state[row] = _at_own_hinge(one, joints.axis[row, 0], joints.pivot[row, 0])
        own_part[row] = _of_all(clouds[row], one.label[0])
        kept += 1
    log.info("%d of %d scans have hinges of their own", kept, len(clouds))
    return replace(found, base=base, state=state, point_part=own_part)


def _same_scan(cloud: Tensor, scans: Tensor) -> Tensor:  # [P, 3], [k, P, 3] -> [k]
    """Whether scans are the cloud, which may be turned."""
    apart = (scans - scans.mean(dim=1, keepdim=True)).norm(dim=-1) - (cloud - cloud.mean(dim=0)).norm(dim=-1)
    return apart.abs().amax(dim=1) < _SAME


def _votes(
    found: RegisteredShape,
    row: int,
    placed: RegisteredShape,  # registered to the other scans
    together: Tensor,  # [k, P, 3]
    part: Tensor,  # [P] of the first
) -> np.ndarray:  # [k, P, K]
    parts = torch.cat([part[None], point_parts(placed, together[1:])])
    count = found.shape.num_parts
    return (functional.one_hot(parts, count) * (_VOTE - (1 - _VOTE)) + (1 - _VOTE)).numpy()


def _at_own_hinge(
    one: OneObject,  # the cloud first
    axis: Tensor,  # [3] of the hinge, in the shape's proportions there
    pivot: Tensor,  # [3]
) -> tuple[Tensor, Tensor]:  # [4, 4], [1]
    """A base that brings a hinge to that of the object, and the joint state."""
    hinge, own = one.shape.joints, one.base[0]
    rotation = own[:3, :3] @ rotation_between(axis.to(own), hinge.axis[0])
    along, through = own[:3, :3] @ hinge.axis[0], own[:3, :3] @ hinge.pivot[0] + own[:3, 3]
    before = own[:3, :3] @ pivot.to(own) + own[:3, 3]
    nearest = through + ((before - through) @ along) * along
    return se3(rotation, nearest - rotation @ pivot.to(own)).to(axis), one.state[0].to(axis)


def _of_all(
    cloud: Tensor,  # [P, 3]
    label: Tensor,  # [N] of the leading points
) -> Tensor:  # [P]
    """What most of the points about a point are of: alone among those of another part, it would be seen to fly off."""
    label = label[nearest_index(cloud[None], cloud[None, : len(label)].contiguous())[0]]
    return label[torch.cdist(cloud, cloud).topk(_NEIGHBOURS, largest=False).indices].mode(dim=1).values
