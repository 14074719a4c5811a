"""Clouds in which an object was placed back to front, upside down, or with parts exchanged.

Coarse discovery places each cloud by a few hundred points, for which a box that is turned by half, or a laptop whose
lid is taken for its base, fits about as well. Of the object's own surface, with normals, what is so placed lies off
all clouds that are placed otherwise; and which way most are placed, all pairs of clouds say together.

How else clouds may be placed, of objects with one hinge the parts' own shapes say, by which turned parts lie on each
other. Of those with several joints, turns go with other states of all joints, and the object is sought in every cloud.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from itertools import permutations

import numpy as np
import roma
import torch
from torch import Tensor

from articulate_ssl.discovery.one_object.adjustment import Placed, adjusted
from articulate_ssl.discovery.one_object.moving_labels import CAP
from articulate_ssl.discovery.one_object.surface import Surface
from articulate_ssl.discovery.registered_shape import state_limits
from articulate_ssl.discovery.registrar import state_starts
from articulate_ssl.discovery.registration import register_rigid
from articulate_ssl.discovery.search import search_articulated
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.geometry.se3 import invert_se3, transform_points
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.joints import Joints

# All chosen, not tuned.
_REGISTERED = 256  # points of a part, to find how it may be turned
_WAYS = 3  # in which a part is turned onto a part, that are looked at, at most
_SOUGHT = 512  # points of every part that are sought in twice as many of a cloud
_COMPARED = 512  # points of a cloud that are compared with other clouds; where bodies are, half of them say
_SAME = 0.3  # radians: what is turned by less is the same way
_NEAR = 0.1  # normalised units: what a hinge is moved by less is where it was
_SWEEPS = 5  # through the clouds, at most
# Of descent, by which a part is turned onto another: by more, what only one of them has pulls both along their faces.
_ITERATIONS = 12


def placed_alike(
    placed: Placed,  # of n clouds, with one hinge, most of them alike
    shape: ArticulatedShape,  # fused from them
    surfaces: Sequence[Surface],  # n
) -> Placed:
    """The same with parts and bodies as most clouds have them; joint states are as they were, for better or worse.

    If all are alike, it is `placed` itself.
    """
    return _standing_alike(_named_alike(placed, shape, surfaces), shape, surfaces)


def sought_alike(
    placed: Placed,  # of n clouds, most of them alike
    shape: ArticulatedShape,  # fused from them
    surfaces: Sequence[Surface],  # n
) -> Placed:
    """The same with clouds as the object is found in them, if they are then more alike; whatever joints it has.

    If all stay, it is `placed` itself.
    """
    joints, limits = shape.joints, state_limits(placed.state).float()
    joints = replace(joints, axis=joints.axis.float(), pivot=joints.pivot.float(), limits=limits)
    thin = shape.thinned(_SOUGHT * shape.num_parts)
    thin = replace(thin, points=thin.points.float(), joints=joints)
    clouds = torch.from_numpy(np.stack([surface.points[: 2 * _SOUGHT] for surface in surfaces])).float()
    rotations, starts = rotation_group(60).elements.to(clouds), state_starts(placed.state.float())
    found = [value[:, :_WAYS].double() for value in search_articulated(thin, clouds, rotations, starts)[:2]]
    base, state = (
        torch.cat([own[:, None], other], dim=1) for own, other in zip((placed.base, placed.state), found, strict=True)
    )
    pose = torch.stack([placed.joints.part_pose(*way) for way in zip(base.unbind(1), state.unbind(1), strict=True)])
    chosen, rows = _most_alike(pose, surfaces, _COMPARED), torch.arange(len(surfaces))
    return replace(placed, base=base[rows, chosen], state=state[rows, chosen]) if chosen.any() else placed


def _named_alike(placed: Placed, shape: ArticulatedShape, surfaces: Sequence[Surface]) -> Placed:
    """With the root where most have it, not where they have the other part; the hinge stays where it is."""
    root, child, joints = placed.joints.chain.root, placed.joints.chain.child[0], placed.joints
    ways = _turns(shape, root, child, lambda turn: _keeps(turn, joints.axis[0], joints.pivot[0]))
    pose = placed.pose
    exchanged = [torch.stack([pose[:, child] @ turn, pose[:, root] @ invert_se3(turn)], dim=1) for turn in ways]
    chosen = _most_alike(torch.stack([pose[:, [root, child]], *exchanged]), surfaces, _COMPARED)
    return _with_bases(placed, torch.stack([pose[:, root]] + [own[:, 0] for own in exchanged]), chosen)


def _standing_alike(placed: Placed, shape: ArticulatedShape, surfaces: Sequence[Surface]) -> Placed:
    """With bodies turned as most are, of which nothing else is known then than where the body is."""
    root = placed.joints.chain.root
    ways = _turns(shape, root, root, lambda turn: _angle(turn, torch.eye(4).to(turn)) > _SAME)
    base = torch.stack([placed.base] + [placed.base @ turn for turn in ways])  # [W, n, 4, 4]
    return _with_bases(placed, base, _most_alike(base[:, :, None], surfaces, _COMPARED // 2))


def _with_bases(placed: Placed, base: Tensor, chosen: Tensor) -> Placed:
    """Placed by the ways [n] that are chosen of bases [W, n, 4, 4]."""
    return replace(placed, base=base[chosen, torch.arange(len(chosen))]) if chosen.any() else placed


def _turns(
    shape: ArticulatedShape,
    source: int,
    target: int,
    wanted: Callable[[Tensor], bool],
) -> list[Tensor]:
    """Ways in which a part is turned [4, 4] to lie on another part, or itself, the best of what is wanted; adjusted."""
    source, target = (shape.points[shape.label == part] for part in (source, target))
    thin = source[:_REGISTERED].float()
    rotations = rotation_group(60).elements.to(thin)
    turns = register_rigid(thin, target[None, :_REGISTERED].float(), rotations, len(rotations))[0][0].double()
    found = []
    for turn in turns:
        if wanted(turn) and all(_angle(turn, other) > _SAME for other in found):
            found.append(turn)
    return [_exactly(turn, source, target) for turn in found[:_WAYS]]


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
    base = adjusted(start, surfaces, np.zeros((2, count), dtype=int), _ITERATIONS).base
    return base[1] @ invert_se3(base[0])


def _most_alike(pose: Tensor, surfaces: Sequence[Surface], count: int) -> Tensor:  # [W, n, K, 4, 4] -> [n]
    """The way of each cloud in which it is nearest to the others, in theirs; a point moves with either part."""
    pose = pose.numpy()
    ways, clouds, parts = pose.shape[:3]
    back = np.linalg.inv(pose)
    thin = [surface.thinned(count) for surface in surfaces]

    @cache
    def apart(one: int, way: int, other: int, its: int) -> float:
        moves = [pose[its, other, part] @ back[way, one, part] for part in range(parts)]
        return float(np.min([surfaces[other].nearest(thin[one].moved(move), CAP) for move in moves], axis=0).mean())

    return torch.tensor(nearest_ways(apart, ways, clouds))


def nearest_ways(apart: Callable[[int, int, int, int], float], ways: int, clouds: int) -> list[int]:
    """The ways of clouds in which they are least apart from each other, all together, as far as sweeps find them.

    From all as they were; and, as of two kinds that are about as many none would change by itself, from two kinds.

    Args:
        apart: Of a cloud in a way from another in its way.
    """
    pairs = list(permutations(range(clouds), 2))

    def swept(chosen: list[int]) -> tuple[float, list[int]]:
        for _ in range(_SWEEPS):
            before = chosen.copy()
            for one in range(clouds):
                others = [other for other in range(clouds) if other != one]
                costs = [sum(apart(one, way, other, chosen[other]) for other in others) for way in range(ways)]
                chosen[one] = int(np.argmin(costs))
            if chosen == before:
                break
        return sum(apart(one, chosen[one], other, chosen[other]) for one, other in pairs), chosen

    def of_two_kinds(way: int) -> list[int]:
        nearer = np.zeros((clouds, clouds))
        for one, other in pairs:
            nearer[one, other] = apart(one, way, other, 0) - apart(one, 0, other, 0)
        kind = np.linalg.eigh(nearer + nearer.T)[1][:, -1] > 0
        return (way * (kind if 2 * kind.sum() <= clouds else ~kind)).tolist()

    return min(map(swept, [[0] * clouds, *map(of_two_kinds, range(1, ways))]))[1]
