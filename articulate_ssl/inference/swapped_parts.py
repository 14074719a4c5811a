"""Two parts that are taken for each other, each seen alone, from near: which of a laptop's plates is the base.

Where the twin of an explanation (`two_ways`) has two hinged parts exchanged, a network that reads whole clouds
(`surface_decision`) sees each of them by half of its points. Here each is shown alone, by 384 of its own, in its own
frame: the hinge, away from it, and the inner side. One network says how much a part looks like the first of the two,
and the odds of an explanation are the difference between what it says of both. Taught by relief that was wrong of one
laptop in twelve, it turned over half as many of clouds with noise as one that saw whole clouds, and none of 200 clean
generated ones (docs/experiments.md, step 218).

What an explanation believes must not show, or a network learns what it believes and not what is so (step 217). So
points are those that both explanations give to the same of the two parts, and frames follow from these points and the
mean of both hinges: an explanation and its twin see the same, in the opposite order.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.inference.packaging import joint_lines
from articulate_ssl.inference.surface_decision import LOOKS, SurfaceDecision, surface_alone
from articulate_ssl.network.hypotheses import Hypotheses
from articulate_ssl.network.surface_network import SurfaceCloud, SurfaceSize
from articulate_ssl.ops.chamfer import nearest_index
from articulate_ssl.ops.spin_images import SPIN_CHANNELS

SIZE = SurfaceSize(read=384, centers=192)
_FEWEST_POINTS = 256  # of either part, with which they are looked at. Chosen.


class PartViews(NamedTuple):
    """The two exchanged parts of B clouds, each alone, in V versions of their clouds.

    Attributes:
        points: [V, B, 2, S, 3] camera space; S is what the network reads in all its looks.
        surface: [V, B, 2, S, SPIN_CHANNELS + 3] spin images and normals, in float16.
        frames: [B, 2, 3, 3] frame -> camera: along the hinge, away from it, to the inner side.
        known: [B] whether enough is seen of both.
    """

    points: Tensor
    surface: Tensor
    frames: Tensor
    known: Tensor

    def rows(self, key: Tensor) -> PartViews:
        """Of some of the clouds."""
        return PartViews(self.points[:, key], self.surface[:, key], self.frames[key], self.known[key])

    @staticmethod
    def concatenate(several: Sequence[PartViews]) -> PartViews:
        """Of all clouds of several batches."""
        points, surface, *rest = zip(*several, strict=True)
        return PartViews(torch.cat(points, dim=1), torch.cat(surface, dim=1), *map(torch.cat, rest))


def exchanged_parts(
    chain: KinematicChain,
    joint_type: int,
    slot: Sequence[int],  # `TwoWays.slot`
) -> tuple[int, int, int] | None:
    """A joint that turns and whose two parts a twin has exchanged, and these parts, the lower number first."""
    if joint_type != REVOLUTE:
        return None
    for joint, (parent, child) in enumerate(zip(chain.parent, chain.child, strict=True)):
        if slot[parent] == child and slot[child] == parent:
            return joint, min(parent, child), max(parent, child)
    return None


def views_of_parts(
    one: Hypotheses,  # H = 1
    twin: Hypotheses,  # H = 1
    slot: Tensor,  # [K] `TwoWays.slot`
    exchanged: tuple[int, int, int],  # of `exchanged_parts`
    versions: Sequence[Tensor],  # of [B, P, 3] farthest-point order: clouds as they are first, then with noise
    read: int = SIZE.read,
) -> PartViews:
    """The parts as the first explanation has them; the twin's are the same in the opposite order.

    Args:
        read: Points that the network reads in one look.
    """
    joint, *parts = exchanged
    dense, shown = versions[0], LOOKS * read
    here, there = (_parts_of_points(explanation, dense) for explanation in (one, twin))
    agreed = here == slot.to(here)[there]
    own = torch.stack([agreed & (here == part) for part in parts], dim=1)  # [B, 2, P]
    known = (own.sum(dim=2) >= _FEWEST_POINTS).all(dim=1)
    own = own | ~known[:, None, None]  # of these nothing is decided
    frames = _frames(dense, own, *_mean_line(one, twin, joint))
    described = [surface_alone(version.repeat_interleave(2, dim=0), own.flatten(0, 1), shown) for version in versions]
    points, surface = (torch.stack(some).unflatten(1, (-1, 2)) for some in zip(*described, strict=True))
    return PartViews(points, surface, frames, known)


@torch.no_grad()
def log_odds_from_near(network: SurfaceDecision, views: PartViews) -> Tensor:  # [B]
    """Logarithm of the odds that the first part is the first; 0 where too little is seen."""
    said = []
    for first in range(LOOKS):
        points, surface = (x[0, :, :, first::LOOKS].flatten(0, 1).to(views.frames) for x in views[:2])
        cloud = SurfaceCloud.of(points, *surface.split([SPIN_CHANNELS, 3], dim=-1), network.size)
        said.append(network.seen(cloud.seen_in(views.frames.flatten(0, 1)[:, None])).view(-1, 2))
    one, other = torch.stack(said).mean(dim=0).unbind(dim=1)
    return (one - other) * views.known


def _parts_of_points(one: Hypotheses, dense: Tensor) -> Tensor:  # [B, P]
    """The nearest posed part."""
    posed = one.posed()[:, 0]
    return nearest_index(dense, posed.flatten(1, 2)) // posed.shape[2]


def _mean_line(one: Hypotheses, twin: Hypotheses, joint: int) -> tuple[Tensor, Tensor]:  # [B, 3], [B, 3]
    """A joint's direction, its sign as in the first explanation, and a point on it, between both explanations."""
    lines = (joint_lines(some, some.object_pose()[:, 0]) for some in (one, twin))
    (here, start), (there, end) = ((axis[:, joint], pivot[:, joint]) for axis, pivot in lines)
    same = (here * there).sum(dim=-1, keepdim=True).sign()
    return functional.normalize(here + same * there, dim=-1), (start + end) / 2


def _frames(
    dense: Tensor,  # [B, P, 3]
    own: Tensor,  # [B, 2, P] bool
    axis: Tensor,  # [B, 3]
    pivot: Tensor,  # [B, 3]
) -> Tensor:  # [B, 2, 3, 3]
    """Of parts, from where they are about their hinge. Which of its two directions the hinge has does not matter."""
    weight = own.to(dense)
    middle = (weight @ dense) / weight.sum(dim=2, keepdim=True)
    axis = axis[:, None].expand_as(middle)
    away = middle - pivot[:, None]
    away = functional.normalize(away - (away * axis).sum(dim=-1, keepdim=True) * axis, dim=-1)
    inner = torch.linalg.cross(axis, away)
    inner = inner * ((middle.flip(1) - middle) * inner).sum(dim=-1, keepdim=True).sign()
    return torch.stack([torch.linalg.cross(away, inner), away, inner], dim=-1)
