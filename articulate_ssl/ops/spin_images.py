"""Spin images: what the surface next to a point looks like, whichever way it is turned (Johnson and Hebert 1999).

A laptop's base and lid differ in millimetres of relief. Kernels as wide as a network's are blind to it, and the points
that a network reads are too few; here the dense cloud is read, closely, once.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor

from articulate_ssl.ops.neighborhood import nearest_neighbors

RADIUS = 0.08  # of the support: several times the spacing of 2048 points on a laptop, about .02
DENSE_POINTS = 2048  # that are read; what depth views have in farthest-point order
NEIGHBORS = 48  # at most, both faces of a plate together
# Heights that still are the own face, fit after fit of its plane: relief is lower, most plates are thicker.
FACES = (0.016, 0.01, 0.007)
# Heights over the own face in cloud units: narrow bins for relief, wide ones for thickness. Chosen without measurement.
HEIGHTS = (-0.07, -0.05, -0.036, -0.026, -0.019, -0.014, -0.01, -0.007, -0.0045, -0.002)
HEIGHTS = (*HEIGHTS, 0.0, 0.002, 0.0045, 0.007, 0.01, 0.016, 0.03)
LEAST = 6  # points that a plane is fitted to; fewer leave the plane as it was, or the image empty
RINGS = (0.0, 0.5, 1.0)  # shares of the radius
SPIN_CHANNELS = len(HEIGHTS) * (len(RINGS) - 1)


@torch.no_grad()
def spin_images(
    points: Tensor,  # [B, N, 3], the leading points of `dense`
    dense: Tensor,  # [B, P, 3]
) -> tuple[Tensor, Tensor]:  # [B, N, SPIN_CHANNELS] in [0, 1], [B, N, 3] unit or zero
    """Histograms of the heights of neighbours over every point's tangent plane, one per ring around the normal.

    And this normal. It is found from the points, as everything else here.

    Normals point and heights are positive away from where most of the neighbours are, that is out of a plate. If the
    cloud is moved rigidly, normals turn and images stay. All is zero where fewer than `LEAST` points are near.
    """
    cloud = dense[:, :DENSE_POINTS]
    if cloud.shape[1] < points.shape[1]:
        cloud = points
    centers = torch.arange(points.shape[1], device=points.device).expand(len(points), -1)
    offset = nearest_neighbors(cloud, NEIGHBORS, centers).offset.permute(0, 2, 3, 1)  # [B, N, n, 3]
    distance = offset.norm(dim=-1)
    near = (1 - (distance / RADIUS).square()).relu()
    _, normal = tangent_plane(offset, near)
    height = (offset @ normal[..., None]).squeeze(-1)
    for face in FACES:
        # Tukey's biweight: what is off the face does not tilt it at all.
        weight = near * (1 - (height / face).square()).relu().square()
        middle, finer = tangent_plane(offset, weight)
        fitted = ((offset - middle[..., None, :]) @ finer[..., None]).squeeze(-1)
        enough = (weight > 0).sum(-1, keepdim=True) >= LEAST
        height, normal = torch.where(enough, fitted, height), torch.where(enough, finer, normal)
    inside = (near > 0).to(height)
    known = (inside.sum(-1, keepdim=True) >= LEAST).to(height)
    inside = inside * known
    outward = torch.where((height * inside).sum(-1, keepdim=True) > 0, -1.0, 1.0)
    height, normal = height * outward, normal * outward * known
    radial = (distance.square() - height.square()).clamp(min=0).sqrt() / RADIUS
    bins = torch.tensor(HEIGHTS, dtype=height.dtype, device=height.device)
    gap = torch.cat([bins[1:2] - bins[:1], bins.diff(), bins[-1:] - bins[-2:-1]])
    above = height[..., None] - bins
    # Linear interpolation between bins.
    share = (1 - torch.maximum(above / gap[1:], -above / gap[:-1])).relu()  # [B, N, n, bins]
    images = []
    for low, high in pairwise(RINGS):
        ring = inside * (radial >= low) * (radial < high)
        total = ring.sum(-1, keepdim=True).clamp(min=1)
        images.append((ring[..., None, :] @ share).squeeze(-2) / total)
    return torch.cat(images, dim=-1), normal


def tangent_plane(
    offset: Tensor,  # [..., n, 3]
    weight: Tensor,  # [..., n]
) -> tuple[Tensor, Tensor]:  # [..., 3], [..., 3] unit
    """Weighted mean of the offsets, and the direction in which they vary least."""
    weight = weight / weight.sum(-1, keepdim=True).clamp(min=1e-12)
    middle = (weight[..., None] * offset).sum(-2)
    centred = (offset - middle[..., None, :]) / RADIUS
    covariance = (weight[..., None] * centred).transpose(-1, -2) @ centred
    return middle, torch.linalg.eigh(covariance).eigenvectors[..., 0]
