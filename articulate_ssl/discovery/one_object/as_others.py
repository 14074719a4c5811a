"""Parts of an object in its clouds, as clouds of other objects say that it has, and as its own motion confirms.

Discovery (`find`) knows nothing of an object but its clouds, and starts from guesses. Where others are understood, they
say which part points are of, about; where parts are follows, then the rounds of discovery make it exact, in which what
others say counts as much as how points move. That takes a third of the time, was right of a chest that discovery had
wrong, and calls parts as others do (docs/experiments.md, step 173).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from articulate_ssl.discovery.discover import DiscoveryError
from articulate_ssl.discovery.one_object.adjustment import Placed
from articulate_ssl.discovery.one_object.find import LABELLED, OneObject, refined
from articulate_ssl.discovery.one_object.surface import Surface
from articulate_ssl.discovery.part_boxes import part_boxes
from articulate_ssl.discovery.similar_clouds import ASKING, LabelledClouds
from articulate_ssl.discovery.synchronization import CAP, unit_boxes
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.ops.chamfer import nearest_distance
from articulate_ssl.shape.joints import Joints

_COMPARED = 256  # points of each cloud by which the object's own clouds are compared
_SWEEPS = 5  # through its clouds, at most
_PART_POINTS = 1024


class AsOthers(NamedTuple):
    """An object that was found so.

    Attributes:
        found: The object, its parts under their common names.
        turn: [n, 3, 3] cloud -> the frame that all objects share.
    """

    found: OneObject
    turn: Tensor


def find_as_others(
    clouds: Tensor,  # [n, N, 3] of one object, complete, in one scale, farthest-point order
    turns: Tensor,  # [n, C, 3, 3] that may turn them into the frame that all objects share, the likeliest first
    labelled: LabelledClouds,  # of other objects
    joints: Joints,  # of their parts, which slide, in that frame
) -> AsOthers:
    """Parts of the object, where they are in every cloud, and which part the leading points are of.

    Raises:
        DiscoveryError: if parts that others have are not found, or do not explain the object.
    """
    turn = turned_alike(turns, clouds)
    standing = clouds @ turn.mT
    boxes = unit_boxes(standing)[0]
    votes = labelled.votes(boxes[:, :ASKING], joints.chain.num_parts, boxes[:, :LABELLED])
    placed = _placed(standing[:, :LABELLED], turn, votes.argmax(dim=-1), joints)
    surfaces = [Surface.of(cloud) for cloud in clouds.double().numpy()]
    found = refined(surfaces, placed, _PART_POINTS, votes.double().numpy())
    if not found.explained:
        raise DiscoveryError(f"{found.unexplained:.0%} of the points of its clouds lie off all its other clouds")
    return AsOthers(found, turn)


def turned_alike(
    turns: Tensor,  # [n, C, 3, 3]
    clouds: Tensor,  # [n, N, 3] of one object
) -> Tensor:  # [n, 3, 3]
    """Of each cloud's turns the one by which it is most like the others, turned by theirs; at first the likeliest."""
    count, choices = turns.shape[:2]
    turned = torch.einsum("ncij,nmj->ncmi", turns, clouds[:, :_COMPARED]).flatten(0, 1)
    boxes = unit_boxes(turned)[0]
    far = [nearest_distance(boxes, one.expand_as(boxes).contiguous()).clamp(max=CAP).mean(dim=1) for one in boxes]
    apart = torch.stack(far)
    apart = (apart + apart.T).view(count, choices, count, choices)
    rows, chosen = torch.arange(count), torch.zeros(count, dtype=torch.long)
    for _ in range(_SWEEPS):
        before = chosen.clone()
        for cloud in range(count):
            others = rows[rows != cloud]
            chosen[cloud] = apart[cloud][:, others, chosen[others]].mean(dim=1).argmin()
        if torch.equal(chosen, before):
            break
    return turns[rows, chosen]


def _placed(
    standing: Tensor,  # [n, M, 3] clouds in the common frame
    turn: Tensor,  # [n, 3, 3]
    part: Tensor,  # [n, M] of their points
    joints: Joints,
) -> Placed:
    """Roughly, by the boxes of the parts: the base in the middle of the root's, slides from the mean."""
    low, high, _ = part_boxes(standing, part, joints.chain.num_parts)
    middle, chain = (low + high) / 2, joints.chain
    state = ((middle[:, list(chain.child)] - middle[:, list(chain.parent)]) * joints.axis).sum(dim=-1)
    base = se3(turn.mT, (turn.mT @ middle[:, chain.root, :, None]).squeeze(-1))
    exact = replace(joints, axis=joints.axis.double(), pivot=joints.pivot.double(), limits=None)
    return Placed(exact, base.double(), (state - state.mean(dim=0)).double())
