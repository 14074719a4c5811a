"""Clouds in which an object was placed back to front, upside down, or with its two parts exchanged.

Coarse discovery places each cloud by a few hundred points, for which a box that is turned by half, or a laptop whose
lid is taken for its base, fits about as well. Of the object's own surface, with normals, what is so placed lies off
all clouds that are placed otherwise; and which way most are placed, all pairs of clouds say together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import roma
import torch
from torch import Tensor

from articulate_ssl.discovery.one_object.adjustment import Placed, adjusted
from articulate_ssl.discovery.one_object.moving_labels import CAP
from articulate_ssl.discovery.one_object.surface import Surface
from articulate_ssl.discovery.registration import register_rigid
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.geometry.se3 import invert_se3, transform_points
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.joints import Joints

# All chosen, not tuned.
_REGISTERED = 256  # points of a part, to find how it may be turned
_WAYS = 3  # in which a body is taken for itself, turned, and for another part, at most
_COMPARED = 256  # points of a cloud that are compared with other clouds
_SAME = 0.3  # radians: what is turned by less is the same way
_NEAR = 0.1  # normalised units: what a hinge is moved by less is where it was
_SWEEPS = 5  # through the clouds, at most


def placed_alike(
    placed: Placed,  # of n clouds, most of them alike
    shape: ArticulatedShape,  # fused from them
    surfaces: Sequence[Surface],  # n
) -> Placed:
    """The same with bodies as most clouds have them; joint states are as they were, for better or worse.

    If all are alike, it is `placed` itself.
    """
    pose = placed.pose
    base = torch.stack([placed.base] + [pose[:, part] @ turn for part, turn in _ways(shape)])  # [W, n, 4, 4]
    chosen = _most_alike(base.numpy(), surfaces)
    return replace(placed, base=base[chosen, torch.arange(len(chosen))]) if chosen.any() else placed


def _ways(shape: ArticulatedShape) -> list[tuple[int, Tensor]]:
    """Which part the root may be taken for, and how it is then turned onto it [4, 4], in canonical object space.

    It may be taken for another part only if the hinge between them stays where it is.
    """
    joints = shape.joints
    root = joints.chain.root
    parts = [shape.points[shape.label == part] for part in range(shape.num_parts)]
    body = parts[root][:_REGISTERED].float()
    rotations = rotation_group(60).elements.to(body)
    found = []
    for part, points in enumerate(parts):
        turns = register_rigid(body, points[None, :_REGISTERED].float(), rotations, len(rotations))[0][0].double()
        ways = [torch.eye(4).double()] if part == root else []
        for turn in turns:
            own = part == root or _keeps(turn, joints.axis[0], joints.pivot[0])
            if own and all(_angle(turn, other) > _SAME for other in ways):
                ways.append(turn)
        ways = ways[1:] if part == root else ways
        found += [(part, _exactly(turn, parts[root], points)) for turn in ways[:_WAYS]]
    return found


def _keeps(
    turn: Tensor,  # [4, 4]
    axis: Tensor,  # [3]
    pivot: Tensor,  # [3]
) -> bool:
    """Whether a line stays about where it is."""
    moved = transform_points(turn, pivot[None])[0] - pivot
    off = (moved - (moved @ axis) * axis).norm()
    return bool((turn[:3, :3] @ axis @ axis).abs().clamp(max=1).acos() < _SAME and off < _NEAR)


def _angle(one: Tensor, other: Tensor) -> float:
    return float(roma.rotmat_geodesic_distance(one[:3, :3], other[:3, :3]))


def _exactly(turn: Tensor, body: Tensor, part: Tensor) -> Tensor:
    """A turn that brings a body onto a part, adjusted."""
    start = Placed(Joints.none(1, turn), torch.stack([torch.eye(4).to(turn), turn]), turn.new_zeros(2, 0))
    count = min(len(body), len(part))
    surfaces = [Surface.of(points[:count].double().numpy()) for points in (body, part)]
    base = adjusted(start, surfaces, np.zeros((2, count), dtype=int)).base
    return base[1] @ invert_se3(base[0])


def _most_alike(pose: np.ndarray, surfaces: Sequence[Surface]) -> Tensor:  # [W, n, 4, 4] -> [n]
    """The way of each cloud in which it is nearest to the others, in theirs; at first all are as they were."""
    ways, count = pose.shape[:2]
    back = np.linalg.inv(pose)
    thin = [surface.thinned(_COMPARED) for surface in surfaces]

    @cache
    def apart(one: int, way: int, other: int, its: int) -> float:
        return float(surfaces[other].nearest(thin[one].moved(pose[its, other] @ back[way, one]), CAP).mean())

    chosen = [0] * count
    for _ in range(_SWEEPS):
        before = chosen.copy()
        for one in range(count):
            others = [other for other in range(count) if other != one]
            costs = [sum(apart(one, way, other, chosen[other]) for other in others) for way in range(ways)]
            chosen[one] = int(np.argmin(costs))
        if chosen == before:
            break
    return torch.tensor(chosen)
