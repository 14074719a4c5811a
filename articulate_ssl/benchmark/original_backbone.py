"""The backbone as the original computes it, to compare ours with."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu

from articulate_ssl.geometry.kernel_points import symmetric_kernel_points
from articulate_ssl.network.backbone import EquivariantBackbone
from articulate_ssl.ops import reference


class OriginalBackbone(nn.Module):
    """The twin of `EquivariantBackbone`: the same parameters, every layer as the original runs it.

    The original's articulated backbone calls its pose-aware convolution with identity poses.
    """

    def __init__(self, backbone: EquivariantBackbone) -> None:
        super().__init__()
        self.backbone = backbone

    def forward(self, points: Tensor) -> Tensor:
        """Features [B, N, G, C] of points [B, N, 3]."""
        group = self.backbone.group
        kernel = symmetric_kernel_points(group, len(self.backbone.kernel_points))
        poses = torch.eye(4, dtype=points.dtype, device=points.device).expand(*points.shape[:2], 4, 4)
        features = points.new_ones(*points.shape[:2], len(group), 1)
        for block, radius in zip(self.backbone.blocks, self.backbone.radii, strict=True):
            features = reference.pose_aware_convolution(
                features, points, poses, block.weight, group, kernel, radius, self.backbone.num_neighbors
            )
            features = leaky_relu(block.norm(features), negative_slope=0.01)
        return features
