"""Kinematic structure (paper, Sec. 3.2): adjacency confidences, pivots and axes of part pairs, and the chain."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn
from torch.nn import functional

from articulate_ssl.geometry.kinematic_chain import KinematicChain, pair_index
from articulate_ssl.network.category_object import CategoryObject
from articulate_ssl.network.heads.perceptron import perceptron
from articulate_ssl.network.options import NetworkOptions
from articulate_ssl.shape.joints import Joints


@dataclass(frozen=True)
class Structure:
    """Adjacency and joint lines of all E part pairs, and those of the chain's J joints, in canonical object space.

    Attributes:
        confidence: [B, E] adjacency confidences.
        pair_pivot: [B, E, 3].
        pair_axis: [B, H, E, 3] unit; one per hypothesis.
        pivot: [B, J, 3].
        axis: [B, H, J, 3] unit; one per hypothesis.
        chain: The kinematic chain that poses are built with.
        joint_type: `REVOLUTE` or `PRISMATIC`.
    """

    confidence: Tensor
    pair_pivot: Tensor
    pair_axis: Tensor
    pivot: Tensor
    axis: Tensor
    chain: KinematicChain
    joint_type: int

    def select(self, rows: Tensor, index: Tensor) -> Structure:
        """Of each cloud the hypotheses [rows, index]."""
        return replace(self, axis=self.axis[rows, index], pair_axis=self.pair_axis[rows, index])

    def repeated(self, count: int) -> Structure:
        """Every hypothesis `count` times, side by side."""
        if count == 1:
            return self
        axis, pair_axis = (value.repeat_interleave(count, dim=1) for value in (self.axis, self.pair_axis))
        return replace(self, axis=axis, pair_axis=pair_axis)

    def joints(self) -> Joints:
        """The chain's joints [B, H, J]."""
        return Joints(self.chain, self.axis, self.pivot[:, None], self.joint_type)


class AxisHead(nn.Module):
    """Axes of the part pairs: the category's, tilted by the features of the part of the higher index."""

    def __init__(self, num_parts: int, options: NetworkOptions) -> None:
        """Args: K; channels."""
        super().__init__()
        dim = options.head_dim
        self.perceptron = nn.ModuleList(perceptron(2 * dim, dim, 3) for _ in range(num_parts))

    def forward(
        self,
        equivariant: Tensor,  # [B, K, G, 2D] part features
        category: CategoryObject,
    ) -> Tensor:  # [B, G, E, 3]
        """One axis per part pair and group element."""
        tilt = torch.stack([head(equivariant[:, k]) for k, head in enumerate(self.perceptron)], dim=2)
        return functional.normalize(category.axis + tilt[:, :, category.pairs[:, 1]], dim=-1)


class PairHead(nn.Module):
    """Adjacency confidences and pivots of the part pairs, from both parts' features: the category's, and a change."""

    def __init__(self, num_parts: int, options: NetworkOptions) -> None:
        """Args: K; channels."""
        super().__init__()
        dim, num_pairs = options.head_dim, num_parts * (num_parts - 1) // 2
        self.perceptron = nn.ModuleList(perceptron(4 * dim, dim, 4) for _ in range(num_pairs))
        self.pairs = pair_index(num_parts).tolist()

    def forward(
        self,
        invariant: Tensor,  # [B, K, 2D] part features
        category: CategoryObject,
    ) -> tuple[Tensor, Tensor]:  # [B, E] and [B, E, 3]
        """Confidences and pivots."""
        both = [torch.cat([invariant[:, i], invariant[:, j]], dim=-1) for i, j in self.pairs]
        out = torch.stack([head(x) for head, x in zip(self.perceptron, both, strict=True)], dim=1)
        return category.confidence + out[..., 0], category.pivot + out[..., 1:]
