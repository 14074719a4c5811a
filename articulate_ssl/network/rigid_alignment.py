"""Stage 0: rigid alignment of the whole shape, before any part is known.

The paper's method needs clouds whose orientation is roughly canonical (its authors' code trains this network first; the
paper mentions it only in a removed comment as "zero iteration"). The whole object is one rigid part here: a category
template plus a small instance flow, posed by one rotation hypothesis per group element; the best hypothesis trains.
"""

from __future__ import annotations

from typing import NamedTuple

import roma
import torch
from torch import Tensor, nn

from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.network.backbone import EquivariantBackbone
from articulate_ssl.network.options import NetworkOptions
from articulate_ssl.network.so3_pointnet import GroupAttentionPooling, part_pointnet

_FLOW_BOUND = 0.05  # what an instance adds at most: stage 0 needs orientations, not shapes


class RigidHypotheses(NamedTuple):
    """One pose of the canonical shape per group element; posed points are `rotation @ shape + translation`."""

    rotation: Tensor  # [B, G, 3, 3]
    translation: Tensor  # [B, G, 3]
    shape: Tensor  # [B, M, 3]

    def posed(self) -> Tensor:
        """Reconstructions Y^g, [B, G, M, 3]."""
        return torch.einsum("bgij,bmj->bgmi", self.rotation, self.shape) + self.translation[:, :, None]


class RigidAlignment(nn.Module):
    """Whole-shape EPN auto-encoder: an invariant canonical shape, and one residual pose per group element."""

    def __init__(self, options: NetworkOptions, num_points: int, flow_bound: float = _FLOW_BOUND) -> None:
        """Args: sizes; points of the canonical shape; how far an instance moves them at most."""
        super().__init__()
        self.flow_bound = flow_bound
        group, dim = rotation_group(options.group_order), options.head_dim
        self.register_buffer("elements", group.elements, persistent=False)
        self.backbone = EquivariantBackbone.of(options)
        self.pointnet = part_pointnet(options.dims[-1], dim, group, options.directions)
        self.pool = GroupAttentionPooling(dim)
        self.pose_head = nn.Sequential(nn.Linear(dim, dim), nn.LeakyReLU(0.1), nn.Linear(dim, 6))
        self.flow_head = nn.Sequential(nn.Linear(dim, dim), nn.LeakyReLU(0.1), nn.Linear(dim, 3 * num_points))
        self.mixed_precision = False  # of the backbone; geometry needs full precision
        self.template = nn.Parameter(0.2 * torch.randn(num_points, 3))
        for head in (self.pose_head, self.flow_head):
            nn.init.normal_(head[-1].weight, std=1e-3)
            nn.init.zeros_(head[-1].bias)

    @torch.no_grad()
    def start_from(
        self,
        cloud: Tensor,  # [N, 3] farthest-point order
    ) -> None:
        """Let the canonical shape start as a cloud of the category.

        From random points poses took twice as many steps to learn (docs/experiments.md, step 164).
        """
        row = torch.arange(len(self.template), device=cloud.device) % len(cloud)
        self.template.copy_(cloud[row] - cloud.mean(dim=0))

    def forward(self, points: Tensor) -> RigidHypotheses:
        """Hypotheses for clouds [B, N, 3]."""
        with torch.autocast(points.device.type, torch.bfloat16, enabled=self.mixed_precision):
            features = self.backbone(points)
        features = features.to(points.dtype)
        centers = points[:, : features.shape[1]]
        mean = points.mean(dim=1, keepdim=True)
        whole = (
            self.pointnet(features, centers - mean, centers.new_ones(*centers.shape[:2], 1)).squeeze(1).to(points.dtype)
        )
        residual = self.pose_head(whole).to(points.dtype)
        flow = self.flow_head(self.pool(whole)).to(points.dtype).view(len(points), -1, 3)
        elements = self.elements.to(residual)
        rotation = elements @ roma.rotvec_to_rotmat(residual[..., :3])
        translation = torch.einsum("gij,bgj->bgi", elements, residual[..., 3:]) + mean
        return RigidHypotheses(rotation, translation, self.template + self.flow_bound * flow.tanh())
