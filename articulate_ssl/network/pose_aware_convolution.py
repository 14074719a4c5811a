"""Pose-aware equivariant point convolution (paper Eq. 2) as plain group convolution of the canonicalised cloud."""

from __future__ import annotations

from torch import Tensor

from datamodules.geometry import invert_se3, transform_points


def canonicalize(
    points: Tensor,  # [B, N, 3]
    poses: Tensor,  # [B, N, 4, 4] canonical -> camera space, of each point's part
) -> Tensor:  # [B, N, 3]
    """y_i = P_i^{-1} x_i: every part moved back to the canonical object space."""
    return transform_points(invert_se3(poses), points[..., None, :]).squeeze(-2)
