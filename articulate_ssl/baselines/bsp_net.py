"""BSP-Net (Chen, Tagliasacchi and Zhang 2020): planes, grouped into convexes, whose union is the shape.

A shape's code becomes p planes. A connection matrix T [p, c], the same for all shapes, says which planes bound which
convex: C = relu(points . planes) T is zero inside a convex and positive outside. Two phases of training:

1. T and the weights W of the union are continuous: S+ = clip(clip(1 - C, 0, 1) W, 0, 1), with the loss
   mean (S+ - occupancy)^2 + L_T + L_W, where L_T = sum of max(-t, 0) + max(t - 1, 0) draws T into [0, 1] (the T+ of the
   paper) and L_W = sum |w - 1|.
2. T is binary, T* = [T > 0.01], and fixed; the union is exact, S* = min C. The loss is
   mean of occupancy max(S*, 0) + (1 - occupancy) (1 - min(S*, 1)).

Convexes have the same number in every shape of a category, which makes them a segmentation. `PrimitiveMethod` says how
they become parts, and what that costs in labels.

As theirs: the layers, the losses, the initial T and W, the threshold. Otherwise: the code comes from the cloud
(`implicit.py`); fewer planes, convexes and units, and phases of minutes, for which planes start around the middle, the
union's clip leaks and L_W weighs less; no third phase against overlap, which they offer for more compact meshes. The
paper does not train it on partial views, as it needs meshes.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from articulate_ssl.baselines.implicit import COORDINATES, SLOPE, CloudEncoder, PrimitiveMethod, draw_samples
from articulate_ssl.baselines.method import Effort, Problem

CODE = 256
UNITS = (256, 512)  # theirs: 512, 1024, 2048
PLANES, CONVEXES = 256, 32  # theirs: 4096, 256
THRESHOLD = 0.01  # theirs
INITIAL_STD, INITIAL_UNION = 0.02, 1e-5  # theirs
UNION_WEIGHT = 0.01  # of L_W; theirs 1, with which W grows before planes have learnt anything, in so few steps
LEAK = 0.01  # slope of the union's clip where it holds; theirs 0, see `leaky_clip`
INITIAL_OFFSETS = (0.05, 0.5)  # least and largest distance of a plane from the middle, in diagonals
NOWHERE = 1e3  # C of a convex without planes: farther than any other
CONTINUOUS_SHARE = 0.5  # of the steps, in the first phase; theirs are about equally long


class BSPNet(PrimitiveMethod):
    """Convexes of a binary space partition as parts.

    Args:
        problem: What is known of the category.
    """

    title = "BSP-Net"
    effort = Effort(steps=4000, batch_size=16, learning_rate=1e-3)
    views = ("complete",)

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem, CONVEXES)
        self.encoder = CloudEncoder(CODE)
        self.planes = nn.Sequential(
            nn.Linear(CODE, UNITS[0]),
            nn.LeakyReLU(SLOPE),
            nn.Linear(UNITS[0], UNITS[1]),
            nn.LeakyReLU(SLOPE),
            nn.Linear(UNITS[1], 4 * PLANES),
        )
        # Planes around the middle, so that convexes start as bounded ones; with few planes random ones enclose nothing.
        with torch.no_grad():
            normal = nn.functional.normalize(torch.randn(3, PLANES), dim=0)
            low, high = INITIAL_OFFSETS
            offset = low + (high - low) * torch.rand(1, PLANES)
            self.planes[-1].bias.copy_(torch.cat([normal, -COORDINATES * offset]).flatten())
        self.connection = nn.Parameter(INITIAL_STD * torch.randn(PLANES, CONVEXES))
        self.union = nn.Parameter(INITIAL_UNION + INITIAL_STD * torch.randn(CONVEXES))

    def plane_distances(
        self,
        cloud: Tensor,  # [B, N, 3] that the shape is read from
        points: Tensor,  # [B, M, 3]
    ) -> Tensor:  # [B, M, p]
        """Value of every plane of a cloud's shape at other points: positive outside. Planes are not normalised."""
        plane = self.planes(self.encoder(cloud)).view(-1, 4, PLANES)
        return COORDINATES * points @ plane[:, :3] + plane[:, 3:]

    @property
    def binary_connection(self) -> Tensor:  # [p, c]
        """T*."""
        return (self.connection > THRESHOLD).to(self.connection.dtype)

    def training_step(self, batch: dict[str, Tensor], batch_idx: int) -> Tensor:
        """Loss of the phase that the step is in."""
        points, occupancy = draw_samples(batch)
        distance = self.plane_distances(batch["points"], points).relu()
        if self.global_step < CONTINUOUS_SHARE * self.effort.steps:
            return self.continuous_loss(distance, occupancy)
        return self.discrete_loss(distance, occupancy)

    def continuous_loss(
        self,
        distance: Tensor,  # [B, M, p] positive part
        occupancy: Tensor,  # [B, M]
    ) -> Tensor:
        """Of the first phase."""
        inside = (1 - distance @ self.connection).clamp(0, 1)
        shape = leaky_clip(inside @ self.union)
        into_range = (-self.connection).relu().sum() + (self.connection - 1).relu().sum()
        return (shape - occupancy).square().mean() + into_range + UNION_WEIGHT * (self.union - 1).abs().sum()

    def discrete_loss(
        self,
        distance: Tensor,  # [B, M, p] positive part
        occupancy: Tensor,  # [B, M]
    ) -> Tensor:
        """Of the second phase."""
        shape = self._outside(distance).amin(-1)
        return (occupancy * shape + (1 - occupancy) * (1 - shape.clamp(max=1))).mean()

    def _outside(self, distance: Tensor) -> Tensor:  # [B, M, c]
        """C of the binary partition; a convex without planes would be all of space, and is nothing instead."""
        connection = self.binary_connection
        return distance @ connection + NOWHERE * (connection.sum(0) == 0)

    def primitive_of(
        self,
        points: Tensor,  # [B, N, 3]
    ) -> Tensor:  # [B, N] int64
        """The convex that a point is in, the one in which it lies deepest; outside all, the nearest by C."""
        distance = self.plane_distances(points, points)
        outside = self._outside(distance.relu())
        bounds = self.binary_connection.bool()
        depth = torch.stack(
            [distance[..., own].amax(-1) if own.any() else outside[..., c] for c, own in enumerate(bounds.T)], dim=-1
        )
        return torch.where(outside > 0, outside, depth.clamp(max=0)).argmin(-1)


def leaky_clip(values: Tensor) -> Tensor:
    """Into [0, 1], all but `LEAK` of what is beyond: where all convexes overlap, a clip would teach nothing."""
    clipped = values.clamp(0, 1)
    return clipped + LEAK * (values - clipped)
