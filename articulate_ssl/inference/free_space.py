"""What depth views say about where nothing is.

A depth camera sees along every ray as far as the first surface. What lies before that, or where no ray met anything, is
empty, so a posed shape that has surfaces there is not what was seen, however near to some surface of it every point of
the view may be. What lies behind may be there or not, as nobody saw it (visibility as of DART, CHSEL and BOP's masks).

Of closed safes, any side of which may be taken for an open door, wrong explanations are hardly farther from their views
than right ones, .0478 for .0413 in the median, but have four times as many points in free space (docs/experiments.md,
step 307).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from articulate_ssl.ops.chamfer import nearest_distance, nearest_index

_POINTS = 2048  # of a view, that are looked at
# Of an object's bounding radius, how far away the camera is held: about that at which simulated cameras are. From .7 to
# 1.5 times as far decide as well, and one view of ninety worse than where the camera was.
_DISTANCE = 2.3
# Distances between neighbouring rays beyond which nothing was seen, and, along a ray, before what was seen. From 2 to 5
# decide alike.
_RAYS = 2.0


class FreeSpace(NamedTuple):
    """Of B depth views, of a camera that looks along z.

    Attributes:
        points: [B, N, 3] that were seen.
        camera: [B, 3] where the camera was, about.
        rays: [B, N, 3] unit, to the points.
        depth: [B, N] along them.
        step: [B] angle between neighbouring rays.
    """

    points: Tensor
    camera: Tensor
    rays: Tensor
    depth: Tensor
    step: Tensor

    @classmethod
    def of(
        cls,
        points: Tensor,  # [B, N, 3] farthest-point order
    ) -> FreeSpace:
        """Of views by themselves: the camera is as far away as one that shows the whole object."""
        points = points[:, :_POINTS]
        low, high = points.amin(dim=1), points.amax(dim=1)
        middle = (low + high) / 2
        radius = (points - middle[:, None]).norm(dim=-1).amax(dim=1)
        camera = middle - _DISTANCE * radius[:, None] * points.new_tensor([0.0, 0.0, 1.0])
        rays, depth = _seen(points, camera)
        # Farthest-point order: what comes later lies between the points before.
        half = points.shape[1] // 2
        return cls(points, camera, rays, depth, nearest_distance(rays[:, half:], rays[:, :half]).median(dim=1).values)

    def rows(self, index: Tensor) -> FreeSpace:
        """Of some of the views, in any order."""
        return FreeSpace(*(value[index] for value in self))

    @torch.no_grad()
    def entered(
        self,
        shape: Tensor,  # [B, M, 3] of posed surfaces, all around
    ) -> Tensor:  # [B]
        """How far shapes reach into it: distance of what is in free space from the view, on average over what shows.

        Has no gradient.
        """
        rays, depth = _seen(shape, self.camera)
        nearest = nearest_index(rays, self.rays)
        beside = (rays - self.rays.gather(1, nearest[..., None].expand_as(rays))).norm(dim=-1)
        reach = _RAYS * self.step[:, None]
        behind = depth - self.depth.gather(1, nearest)
        outside, slack = beside > reach, reach * depth
        free, hidden = outside | (behind < -slack), ~outside & (behind > slack)
        distance = nearest_distance(shape, self.points)
        return (distance * free).sum(dim=1) / (~hidden).sum(dim=1).clamp(min=1)


def _seen(points: Tensor, camera: Tensor) -> tuple[Tensor, Tensor]:
    """Unit rays [B, N, 3] from a camera [B, 3], and depths [B, N] along them."""
    sight = points - camera[:, None]
    return normalize(sight, dim=-1), sight.norm(dim=-1)
