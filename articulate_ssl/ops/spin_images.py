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
_MOST_PLANES = 2**15  # that a GPU fits at a time: cuSOLVER fails at 65,536 matrices (docs/experiments.md, step 213)
RINGS = (0.0, 0.5, 1.0)  # shares of the radius
SPIN_CHANNELS = len(HEIGHTS) * (len(RINGS) - 1)


@torch.no_grad()
def spin_images(
    points: Tensor,  # [B, N, 3], the leading points of `dense`
    dense: Tensor,  # [B, P, 3]
) -> tuple[Tensor, Tensor]:  # [B, N, SPIN_CHANNELS] in [0, 1], [B, N, 3] unit or zero
    """Histograms of the heights of neighbours over every point's tangent plane, one per ring around the normal.

    And this normal. It is found from the points, as everything else here. `ops.reference` has the readable twin; this
    one keeps coordinates apart and, on a CPU, what it works on in cache.

    Normals point and heights are positive away from where most of the neighbours are, that is out of a plate. If the
    cloud is moved rigidly, normals turn and images stay. All is zero where fewer than `LEAST` points are near.
    """
    cloud = dense[:, :DENSE_POINTS]
    if cloud.shape[1] < points.shape[1]:
        cloud = points
    centers = torch.arange(points.shape[1], device=points.device).expand(len(points), -1)
    samples = 1 if points.device.type == "cpu" else max(1, _MOST_PLANES // points.shape[1])
    found = [
        _images(nearest_neighbors(some, NEIGHBORS, at).offset)
        for some, at in zip(cloud.split(samples), centers.split(samples), strict=True)
    ]
    images, normal = zip(*found, strict=True)
    return torch.cat(images), torch.cat(normal)


def _images(
    offset: Tensor,  # [B, 3, N, n] of the neighbours
) -> tuple[Tensor, Tensor]:  # [B, N, SPIN_CHANNELS], [B, N, 3]
    """See `spin_images`."""
    square = offset.square().sum(dim=1)
    near = (1 - square / RADIUS**2).relu()
    middle, normal = _tangent_plane(offset, near)
    height = _over(offset, normal)
    for face in FACES:
        # Tukey's biweight: what is off the face does not tilt it at all.
        weight = near * (1 - (height / face).square()).relu().square()
        middle, finer = _tangent_plane(offset, weight)
        enough = (weight > 0).sum(-1) >= LEAST
        fitted = _over(offset - middle[..., None], finer)
        height = torch.where(enough[..., None], fitted, height)
        normal = torch.where(enough[:, None], finer, normal)
    inside = (near > 0).to(height)
    known = (inside.sum(-1) >= LEAST).to(height)
    outward = torch.where((height * inside).sum(-1) > 0, -known, known)
    height, normal = height * outward[..., None], normal * outward[:, None]
    radial = (square - height.square()).clamp(min=0).sqrt() / RADIUS
    rings = [inside * (radial >= low) * (radial < high) for low, high in pairwise(RINGS)]
    rings = [ring * (known / ring.sum(-1).clamp(min=1))[..., None] for ring in rings]
    bins, images = (2 * HEIGHTS[0] - HEIGHTS[1], *HEIGHTS, 2 * HEIGHTS[-1] - HEIGHTS[-2]), []
    for low, middle, high in zip(bins, bins[1:], bins[2:], strict=False):
        # Linear interpolation between bins.
        share = torch.minimum((height - low) / (middle - low), (high - height) / (high - middle)).relu()
        images.append([(ring * share).sum(-1) for ring in rings])
    return torch.stack([some for ring in zip(*images, strict=True) for some in ring], dim=-1), normal.mT


def _tangent_plane(
    offset: Tensor,  # [B, 3, N, n]
    weight: Tensor,  # [B, N, n]
) -> tuple[Tensor, Tensor]:  # [B, 3, N], [B, 3, N] unit
    """Weighted mean of the offsets, and the direction in which they vary least."""
    weight = weight / weight.sum(-1, keepdim=True).clamp(min=1e-12)
    middle = (weight[:, None] * offset).sum(-1)
    centred = (offset - middle[..., None]) / RADIUS
    weighted = weight[:, None] * centred
    rows = [torch.stack([(weighted[:, i] * centred[:, j]).sum(-1) for j in range(3)], dim=-1) for i in range(3)]
    return middle, torch.linalg.eigh(torch.stack(rows, dim=-2)).eigenvectors[..., 0].mT


def _over(
    offset: Tensor,  # [B, 3, N, n]
    normal: Tensor,  # [B, 3, N]
) -> Tensor:  # [B, N, n]
    """Heights over planes through the origin."""
    return (offset * normal[..., None]).sum(dim=1)
