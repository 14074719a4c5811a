"""What sliding costs: how far points of a template are from each cloud when they slide by any offset along one axis.

Clouds stand in a common frame. Across the slide they are stretched to one width; along it they are scaled by the
mean of the two, and stand with their backs, which no slide moves, on one plane. How deep an object is, which open
drawers hide, is read off together with the offsets: of a few depths, the one at which all parts fit best.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import one_hot

from articulate_ssl.discovery.distance_field import DistanceFields
from articulate_ssl.discovery.synchronization import unit_boxes
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.shape.articulated_shape import ArticulatedShape

# The fields hold objects as deep as one and a half of their widths across, with drawers as far out as that again less.
_ACROSS = 0.7  # width across
_BACK = -0.66  # where backs stand
_OFFSETS = 0.015 * torch.arange(-32, 33)  # up to two thirds of the width across either way, a cell of the field apart
DEPTHS = torch.tensor([0.7, 0.76, 0.82, 0.88, 0.94, 1.0, 1.06, 1.13, 1.2, 1.28, 1.36])  # over the template's
# Of clouds of one object: their depth, and the largest extent of any, in the unit in which the fields hold all.
SAME_DEPTH, SAME_EXTENT = torch.ones(1), 1.3
CAP = 0.06  # distances beyond count as this
_NEIGHBOURS = 12  # points over which costs are averaged
_DEPTH_ROUNDS, _PROFILE_ROUNDS = 3, 6
_APART = 0.08  # offsets nearer than this are one


class Direction(NamedTuple):
    """Which way parts slide open: along a coordinate axis, by its sign."""

    axis: int
    sign: int

    def vector(self, like: Tensor) -> Tensor:
        """[3] unit."""
        return self.sign * one_hot(torch.tensor(self.axis), 3).to(like)

    @staticmethod
    def of(vector: Tensor) -> Direction:
        """The nearest to a vector [3]."""
        axis = int(vector.abs().argmax())
        return Direction(axis, 1 if vector[axis] > 0 else -1)


DIRECTIONS = tuple(Direction(axis, sign) for axis in range(3) for sign in (1, -1))


class Standing(NamedTuple):
    """Clouds as the table takes them, and how to get back.

    Attributes:
        points: [n, N, 3].
        center: [n, 3] in the common frame, of what has become the origin.
        width: [n, 3] in the common frame, of what has become one.
    """

    points: Tensor
    center: Tensor
    width: Tensor

    @staticmethod
    def of(
        clouds: Tensor,  # [n, N, 3] in a common frame
        direction: Direction,
        unit: float | None = None,
    ) -> Standing:
        """Stand clouds with their backs on one plane; with a unit, without stretching them to one width."""
        axis, sign = direction
        _, center, width = unit_boxes(clouds)
        back = center[:, axis] - sign * width[:, axis] / 2
        if unit is None:
            across = [other for other in range(3) if other != axis]
            width[:, axis] = width[:, across].prod(dim=1).sqrt()
            width = width / _ACROSS
        else:
            width = torch.full_like(width, unit)
        center[:, axis] = back - sign * _BACK * width[:, axis]
        return Standing((clouds - center[:, None]) / width[:, None], center, width)


def offset_costs(
    template: Tensor,  # [T, 3] standing
    fields: DistanceFields,
    cloud: int,
    direction: Direction,
    depths: Tensor = DEPTHS,
) -> Tensor:  # [T, depths, offsets]
    """Distance of every point and its neighbours to one cloud, at every depth and offset."""
    near = torch.cdist(template, template).topk(min(_NEIGHBOURS, len(template)), largest=False).indices
    along = direction.sign * template[:, direction.axis]
    height = (along - _BACK) * depths[:, None, None] + _BACK + _OFFSETS[:, None]  # [depths, offsets, T]
    slid = template.expand(*height.shape, 3).clone()
    slid[..., direction.axis] = direction.sign * height
    return fields.at(cloud, slid).clamp(max=CAP)[..., near].mean(dim=-1).permute(2, 0, 1)


class Slides(NamedTuple):
    """Pieces of a template and how they slide.

    Attributes:
        label: [T] pieces 0..K-1.
        offset: [K, n] of every piece in every cloud.
        cost: Mean distance that is left.
    """

    label: Tensor
    offset: Tensor
    cost: float


def cluster_slides(
    table: Tensor,  # [T, n, depths, offsets]
    num_parts: int,
    min_share: float,
    restarts: int,
    generator: torch.Generator,
    depths: Tensor = DEPTHS,
) -> Slides | None:
    """Pieces whose points slide alike in all clouds, whatever they surround; None if none has points enough.

    K profiles (an offset per cloud) start at random points; each point goes to the cheapest profile, each profile to
    the best offsets of its points. Between rounds of restarts every cloud's depth is read anew.
    """
    depth = torch.full(table.shape[1:2], int((depths == 1).nonzero()))
    best = None
    for _ in range(_DEPTH_ROUNDS):
        flat = table[:, torch.arange(table.shape[1]), depth]  # [T, n, offsets]
        found = [_profiles(flat, num_parts, generator) for _ in range(restarts)]
        found = [f for f in found if torch.bincount(f.label, minlength=num_parts).min() >= min_share * len(flat)]
        if not found:
            return best
        best = min(found, key=lambda slides: slides.cost)
        member = one_hot(best.label, num_parts).to(table)
        by_depth = (member.T @ table.flatten(1)).unflatten(1, table.shape[1:]).amin(dim=-1).sum(dim=0)  # [n, depths]
        depth = by_depth.argmin(dim=1)
    return best


def _profiles(table: Tensor, num_parts: int, generator: torch.Generator) -> Slides:
    """From random points [K], alternately: points to profiles, profiles to points."""
    place = table[torch.randint(len(table), (num_parts,), generator=generator)].argmin(dim=-1)  # [K, n]
    for _ in range(_PROFILE_ROUNDS):
        index = place[:, None, :, None].expand(-1, len(table), -1, 1)
        cost = table.expand(num_parts, -1, -1, -1).gather(3, index).squeeze(-1).mean(dim=2)  # [K, T]
        label = cost.argmin(dim=0)
        member = one_hot(label, num_parts).to(table)
        place = (member.T @ table.flatten(1)).unflatten(1, table.shape[1:]).argmin(dim=-1)
    return Slides(label, _OFFSETS[place], float(cost.amin(dim=0).mean()))


class Placement(NamedTuple):
    """C ways in which a shape whose parts all slide one way may be in each of n clouds, the likeliest first.

    Attributes:
        base: [n, C, 4, 4] base poses.
        state: [n, C, J] joint states.
        log_stretch: [n, C, K, 3].
    """

    base: Tensor
    state: Tensor
    log_stretch: Tensor


def place(
    shape: ArticulatedShape,
    clouds: Tensor,  # [n, N, 3] in the shape's canonical frame, but for translation, depth and width
    num_points: int,
    fields: DistanceFields | None = None,  # of the clouds standing for the direction of the slide, if known
    depths: Tensor = DEPTHS,
    unit: float | None = None,  # as in `Standing.of`
) -> Placement:
    """Read off where a shape's parts are: each where it fits best, and with one of them where it fits second best."""
    direction, chain = Direction.of(shape.joints.axis[0]), shape.joints.chain
    own, standing = Standing.of(shape.points[None], direction, unit), Standing.of(clouds, direction, unit)
    fields = DistanceFields.of(standing.points) if fields is None else fields
    depth, offset = _best_offsets(shape, own.points[0], fields, direction, num_points, depths)  # [n], [n, C, K]
    along = standing.width[:, direction.axis]
    state = (offset[..., list(chain.child)] - offset[..., [chain.root]]) * along[:, None, None]
    ratio = standing.width / own.width
    ratio[:, direction.axis] *= depth
    # Where the middle of the root, about which it stretches, comes to lie.
    middle = shape.part(chain.root).mean(dim=0)
    inside = (middle - own.center[0]) / own.width[0]
    target = (standing.center + inside * standing.width)[:, None].expand(*offset.shape[:2], 3).clone()
    height = (direction.sign * inside[direction.axis] - _BACK) * depth[:, None] + _BACK + offset[..., chain.root]
    target[..., direction.axis] = standing.center[:, None, direction.axis] + direction.sign * height * along[:, None]
    base = se3(torch.eye(3).to(clouds).expand(*offset.shape[:2], 3, 3), target - middle)
    log_stretch = ratio.log()[:, None, None].expand(*offset.shape, 3)
    return Placement(base, state, log_stretch)


def _best_offsets(
    shape: ArticulatedShape,
    template: Tensor,
    fields: DistanceFields,
    direction: Direction,
    num_points: int,
    depths: Tensor,
) -> tuple[Tensor, Tensor]:
    """Depth [n] and offsets [n, 1 + K, K]: the best of all parts, and the best of all but one."""
    thin = torch.linspace(0, len(template) - 1, min(len(template), num_points)).round().long()
    member = one_hot(shape.label[thin], shape.num_parts).to(template)
    chosen, offsets = [], []
    for cloud in range(len(fields.values)):
        table = offset_costs(template[thin], fields, cloud, direction, depths)
        cost = (member.T @ table.flatten(1)).unflatten(1, table.shape[1:])  # [K, depths, offsets]
        depth = cost.amin(dim=-1).sum(dim=0).argmin()
        best = cost[:, depth].argmin(dim=-1)  # [K]
        near = (_OFFSETS[best][:, None] - _OFFSETS).abs() < _APART
        second = cost[:, depth].masked_fill(near, torch.inf).argmin(dim=-1)
        others = torch.where(torch.eye(shape.num_parts, dtype=torch.bool), second, best)
        chosen.append(depths[depth])
        offsets.append(_OFFSETS[torch.cat([best[None], others])])
    return torch.stack(chosen).to(template), torch.stack(offsets).to(template)
