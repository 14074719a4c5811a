"""Canonical part shapes Z_i and assembling translations p_i^c (paper, Sec. 3.2 and "Part-assembling Parameters")."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from articulate_ssl.network.category_object import CategoryObject
from articulate_ssl.network.heads.perceptron import perceptron
from articulate_ssl.network.options import NetworkOptions
from articulate_ssl.shape.stretch import stretch_matrices


class CanonicalShape(NamedTuple):
    """Shapes of an instance's parts, and how they are assembled.

    Attributes:
        part_shape: [B, K, M, 3] canonical part shapes Z_i, each about its own origin.
        assembly: [B, K, 3] translations p_i^c into canonical object space.
    """

    part_shape: Tensor
    assembly: Tensor

    def object_shape(self) -> Tensor:
        """Canonical object shape Z = {Z_i + p_i^c}, [B, K, M, 3]."""
        return self.part_shape + self.assembly[:, :, None]


class ShapeHead(nn.Module):
    """The category's shapes, stretched along their principal axes, displaced point by point, and shifted.

    Attributes:
        freedom: Share of all that, in [0, 1], which recipes may raise in the course of training.
    """

    def __init__(self, num_parts: int, options: NetworkOptions) -> None:
        """Args: K; bounds of stretch and flow, points of a shape, channels."""
        super().__init__()
        self.freedom = 1.0
        self.stretch_bound, self.flow_bound = options.stretch_bound, options.flow_bound
        dim, outputs = options.head_dim, 6 + 3 * options.shape_points
        self.perceptron = nn.ModuleList(perceptron(2 * dim, dim, outputs) for _ in range(num_parts))

    def forward(
        self,
        invariant: Tensor,  # [B, K, 2D] part features
        category: CategoryObject,
    ) -> CanonicalShape:
        """Shapes of the instances."""
        out = torch.stack([head(invariant[:, k]) for k, head in enumerate(self.perceptron)], dim=1)
        shift, stretch, flow = out.split([3, 3, out.shape[-1] - 6], dim=-1)
        if self.freedom < 1:
            shift, stretch, flow = (self.freedom * value for value in (shift, stretch, flow))
        stretch = stretch_matrices(category.principal_axes, self.stretch_bound * stretch.tanh())
        shape = torch.einsum("bkij,kmj->bkmi", stretch, category.template)
        shape = shape + self.flow_bound * flow.unflatten(-1, (-1, 3)).tanh()
        return CanonicalShape(shape, category.assembly + shift)
