"""Pose-aware equivariant point convolution (paper Eq. 2) as plain group convolution of the canonicalised cloud.

With y_i = P_i^{-1} x_i the offset to a pose-aligned neighbour is x_i - P_i P_j^{-1} x_j = R_i (y_i - y_j), so the sum
of Eq. 2 is an ordinary group convolution on the cloud whose parts are all moved back to canonical space, at the cost of
one pass. A stack of such layers needs no relabelling in between, and features read in the canonical frame are exact
for any rotation of a part, not only for the group's elements.

Convention:
    The paper rotates offsets by g, so there aligning features reads F(x_j, g R_i R_j^{-1}); here g rotates the kernel
    (`group_convolution`), which names the same feature by the inverse element: F(x_j, R_j R_i^{-1} g).
"""

from __future__ import annotations

import torch
from torch import Tensor

from articulate_ssl.geometry.kernel_points import KernelPoints
from articulate_ssl.geometry.rotation_group import RotationGroup
from articulate_ssl.geometry.se3 import invert_se3, transform_points
from articulate_ssl.ops.group_convolution import group_convolution
from articulate_ssl.ops.neighborhood import build_neighborhood


def canonicalize(
    points: Tensor,  # [B, N, 3]
    poses: Tensor,  # [B, N, 4, 4] canonical -> camera space, of each point's part
) -> Tensor:  # [B, N, 3]
    """y_i = P_i^{-1} x_i: every part moved back to the canonical object space."""
    return transform_points(invert_se3(poses), points[..., None, :]).squeeze(-2)


def to_camera_frame(
    features: Tensor,  # [B, N, G, C] canonical frame
    poses: Tensor,  # [B, N, 4, 4]
    group: RotationGroup,
) -> Tensor:  # [B, N, G, C]
    """Features indexed by rotations of the camera frame, by the group element nearest to each point's rotation.

    F_camera(x_i, g) = F_canonical(y_i, R_i^{-1} g); exact where R_i is in the group.
    """
    return _relabel(features, group.inverse.to(poses.device)[group.nearest(poses[..., :3, :3])], group)


def to_canonical_frame(
    features: Tensor,  # [B, N, G, C] camera frame
    poses: Tensor,  # [B, N, 4, 4]
    group: RotationGroup,
) -> Tensor:  # [B, N, G, C]
    """The inverse of `to_camera_frame`: F_canonical(y_i, g) = F_camera(x_i, R_i g)."""
    return _relabel(features, group.nearest(poses[..., :3, :3]), group)


def pose_aware_convolution(
    features: Tensor,  # [B, N, G, C] camera frame
    points: Tensor,  # [B, N, 3]
    poses: Tensor,  # [B, N, 4, 4]
    weight: Tensor,  # [K, C, C']
    group: RotationGroup,
    kernel: KernelPoints,
    radius: float,
    num_neighbors: int,
) -> Tensor:  # [B, N, G, C'] camera frame
    """One pose-aware layer; neighbourhoods are taken in canonical space (paper, appendix on the convolution)."""
    neighborhood = build_neighborhood(canonicalize(points, poses), radius, kernel.points, num_neighbors)
    canonical = to_canonical_frame(features, poses, group)
    result = group_convolution(canonical, neighborhood, weight, kernel.permutation.to(points.device))
    return to_camera_frame(result, poses, group)


def _relabel(features: Tensor, element: Tensor, group: RotationGroup) -> Tensor:
    """Feature (i, g) becomes the one at (i, element_i g)."""
    index = group.product.to(element.device)[element]  # [B, N, G]
    return torch.take_along_dim(features, index[..., None], dim=2)
