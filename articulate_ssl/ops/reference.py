"""Readable twins of the fast operators, computed as the original implementation does. For tests and benchmarks."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import layer_norm, leaky_relu

from articulate_ssl.geometry.kernel_points import KernelPoints
from articulate_ssl.geometry.rotation_group import RotationGroup
from articulate_ssl.geometry.se3 import invert_se3, transform_points
from articulate_ssl.ops.neighborhood import INFLUENCE, KERNEL_RADIUS, Neighborhood
from articulate_ssl.ops.spin_images import DENSE_POINTS, FACES, HEIGHTS, LEAST, NEIGHBORS, RADIUS, RINGS


def group_convolution(
    features: Tensor | None,  # [B, N, G, C], or None for the constant one with C = 1
    neighborhood: Neighborhood,
    weight: Tensor,  # [K, C, C']
    permutation: Tensor,  # [G, K]
) -> Tensor:  # [B, M, G, C']
    """Group convolution with a correlation weight per neighbour, kernel point and group element, in plain autograd."""
    index, correlation = neighborhood.index, neighborhood.weight
    if features is None:
        features = weight.new_ones(index.shape[0], neighborhood.num_points, permutation.shape[0], 1)
    rotated = correlation[..., permutation]  # [B, M, n, G, K]: entry (g, k) belongs to kernel point A_g kappa_k
    sample = torch.arange(index.shape[0], device=index.device)[:, None, None]
    grouped = features[sample, index]  # [B, M, n, G, C]
    aggregate = torch.einsum("bmngk,bmngc->bmgkc", rotated, grouped)
    return torch.einsum("bmgkc,kcd->bmgd", aggregate, weight)


def separable_group_convolution(
    features: Tensor,  # [B, N, G, C]
    neighborhood: Neighborhood,
    spatial: Tensor,  # [K, C]
    mixing: Tensor,  # [C, C']
    permutation: Tensor,  # [G, K]
) -> Tensor:  # [B, M, G, C']
    """Group convolution with the full kernel that a spatial kernel per channel and a mixing of channels amount to."""
    return group_convolution(features, neighborhood, spatial[:, :, None] * mixing, permutation)


def direction_convolution(
    features: Tensor,  # [B, N, V, C]
    neighborhood: Neighborhood,
    spatial: Tensor,  # [O, C]
    mixing: Tensor,  # [C, C']
    orbit: Tensor,  # [V, K, V]
) -> Tensor:  # [B, M, V, C']
    """Direction convolution with the kernel written out for every triple, in plain autograd."""
    sample = torch.arange(len(features), device=features.device)[:, None, None]
    grouped = features[sample, neighborhood.index]  # [B, M, n, V, C]
    aggregate = torch.einsum("bmnk,bmnuc->bmkuc", neighborhood.weight, grouped)
    return torch.einsum("bmkuc,vkuc->bmvc", aggregate, spatial[orbit]) @ mixing


def chamfer(
    points: Tensor,  # [*, N, 3]
    target: Tensor,  # [*, M, 3]
    squared: bool = False,
    bidirectional: bool = True,
    weight: Tensor | None = None,  # [*, N]
) -> Tensor:  # [*]
    """Chamfer distance with the whole distance matrix under autograd."""
    distance = torch.cdist(points, target, compute_mode="donot_use_mm_for_euclid_dist")
    if squared:
        distance = distance.square()
    forward = distance.amin(dim=-1)
    if weight is None:
        weight = torch.ones_like(forward)
    result = (weight * forward).sum(dim=-1) / weight.sum(dim=-1)
    return result + distance.amin(dim=-2).mean(dim=-1) if bidirectional else result


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
    """Paper Eq. 2 neighbour by neighbour, as the original: every pair aligned, matched with the group, and correlated.

    With identity poses this is what the original runs for each layer of its backbone, with its two large intermediates:
    products of every pair's rotation and all group elements with all group elements (4.25 GB at paper size), and
    correlation weights of every pair, group element and kernel point.
    """
    B, N = points.shape[:2]
    sigma = INFLUENCE * radius**2
    elements = group.elements.to(points)
    rotation = poses[..., :3, :3]
    with torch.no_grad():
        canonical = transform_points(invert_se3(poses), points[..., None, :]).squeeze(-2)
        distance, index = torch.cdist(canonical, canonical, compute_mode="donot_use_mm_for_euclid_dist").topk(
            min(num_neighbors, N), dim=-1, largest=False
        )
        sample = torch.arange(B, device=points.device)[:, None, None]
        aligned = poses[:, :, None] @ invert_se3(poses)[sample, index]  # [B, N, n, 4, 4] P_i P_j^{-1}
        offset = transform_points(aligned, points[sample, index][..., None, :]).squeeze(-2) - points[:, :, None]
        relative = rotation[sample, index] @ rotation[:, :, None].transpose(-1, -2)  # R_j R_i^{-1}
        turned = relative[..., None, :, :] @ elements
        relation = torch.einsum("bmngij,hkj->bmnghik", turned, elements)  # [B, N, n, G, G, 3, 3]
        match = relation.diagonal(dim1=-2, dim2=-1).sum(dim=-1).argmax(dim=-1)  # [B, N, n, G] largest trace
        rotated = torch.einsum("gxy,ky->gkx", elements, KERNEL_RADIUS * radius * kernel.points.to(points))
        square = (offset[:, :, :, None, None] - rotated).square().sum(dim=-1)  # [B, N, n, G, K]
        inside = (distance <= radius).to(points)
        share = inside / inside.sum(dim=-1, keepdim=True)
        correlation = (1 - square / sigma).clamp(min=0) * share[..., None, None]
    grouped = features[sample[..., None], index[..., None], match]  # [B, N, n, G, C]
    aggregate = torch.einsum("bmngk,bmngc->bmgkc", correlation, grouped)
    return torch.einsum("bmgkc,kcd->bmgd", aggregate, weight)


def layer_norm_leaky_relu(
    features: Tensor,  # [..., C]
    weight: Tensor,  # [C]
    bias: Tensor,  # [C]
    slope: float,
    eps: float = 1e-5,
) -> Tensor:  # [..., C]
    """LeakyReLU(LayerNorm(features)) in plain autograd."""
    return leaky_relu(layer_norm(features, weight.shape, weight, bias, eps), slope)


def spin_images(
    points: Tensor,  # [B, N, 3], the leading points of `dense`
    dense: Tensor,  # [B, P, 3]
) -> tuple[Tensor, Tensor]:  # [B, N, SPIN_CHANNELS] in [0, 1], [B, N, 3] unit or zero
    """Histograms of heights over tangent planes, and normals, as `ops.spin_images` says, all neighbours at once."""
    cloud = dense[:, :DENSE_POINTS]
    if cloud.shape[1] < points.shape[1]:
        cloud = points
    between = torch.cdist(points, cloud, compute_mode="donot_use_mm_for_euclid_dist")
    near = between.topk(min(NEIGHBORS, cloud.shape[1]), largest=False).indices  # [B, N, n]
    offset = cloud[torch.arange(len(cloud), device=cloud.device)[:, None, None], near] - points[:, :, None]
    distance = offset.norm(dim=-1)
    near = (1 - (distance / RADIUS).square()).relu()
    _, normal = _tangent_plane(offset, near)
    height = (offset @ normal[..., None]).squeeze(-1)
    for face in FACES:
        # Tukey's biweight: what is off the face does not tilt it at all.
        weight = near * (1 - (height / face).square()).relu().square()
        middle, finer = _tangent_plane(offset, weight)
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


def _tangent_plane(
    offset: Tensor,  # [..., n, 3]
    weight: Tensor,  # [..., n]
) -> tuple[Tensor, Tensor]:  # [..., 3], [..., 3] unit
    """Weighted mean of the offsets, and the direction in which they vary least."""
    weight = weight / weight.sum(-1, keepdim=True).clamp(min=1e-12)
    middle = (weight[..., None] * offset).sum(-2)
    centred = (offset - middle[..., None, :]) / RADIUS
    covariance = (weight[..., None] * centred).transpose(-1, -2) @ centred
    return middle, torch.linalg.eigh(covariance).eigenvectors[..., 0]


def least_variance(
    points: np.ndarray,  # [m, 3]
    neighbours: np.ndarray,  # [m, n]
    counts: Sequence[int],
) -> np.ndarray:  # [m, len(counts)]
    """The least eigenvalue of the covariance of every point's leading neighbours."""
    found = []
    for count in counts:
        patch = points[neighbours[:, :count]]
        patch = patch - patch.mean(axis=1, keepdims=True)
        found.append(np.linalg.eigvalsh(patch.transpose(0, 2, 1) @ patch / count)[:, 0])
    return np.stack(found, axis=1)
