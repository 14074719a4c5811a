"""A cloud's surface as it is seen in some frame: kernel-point convolutions of spin images, pooled over the cloud.

A group convolution without intra-group convolution computes the features at group element g from those at g alone: they
are an ordinary kernel-point convolution of the cloud turned by g^-1 (a test holds it against `GroupConvolutionBlock` of
the icosahedral group). So the features of a rotation mode are those of a turned copy of the cloud, and a network that
sees one copy only is a KPConv with rigid kernels (Thomas et al. 2019).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from articulate_ssl.geometry.kernel_points import KernelPoints, symmetric_kernel_points
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.network.backbone import GroupConvolutionBlock
from articulate_ssl.ops.neighborhood import Neighbors, correlate, nearest_indices, nearest_neighbors
from articulate_ssl.ops.spin_images import SPIN_CHANNELS

MODES = 60  # kernels are those of the icosahedral group


@dataclass(frozen=True)
class SurfaceSize:
    """Sizes for two CPU cores, chosen for the time of a step.

    Attributes:
        read: Leading points that the first layer reads.
        centers: Of these, how many are left after it; heads speak of all points.
        dims: Channels of the backbone's layers.
        radii: Ball radius of each layer.
        num_neighbors: At most, in a ball.
        num_kernel_points: As in `NetworkOptions`.
        global_dim: Channels that are pooled over the cloud.
        head_dim: Channels of the heads' hidden layers.
    """

    read: int = 256
    centers: int = 128
    dims: tuple[int, ...] = (32, 64, 64)
    radii: tuple[float, ...] = (0.15, 0.3, 0.4)
    num_neighbors: int = 16
    num_kernel_points: int = 13
    global_dim: int = 192
    head_dim: int = 128


class SurfaceCloud(NamedTuple):
    """What a cloud is like, of which only coordinates and normals depend on the frame that it is seen in.

    Attributes:
        points: [B, N, 3] about the mean of those that the first layer reads.
        normal: [B, M, 3] of these, as `spin_images` finds them.
        surface: [B, M, SPIN_CHANNELS] of these.
        first_neighbors: [B, M, n] of all of them.
        last_neighbors: [B, M', n] of those that are left after the first layer.
        near: [B, N, 3] nearest of the latter.
        near_weight: [B, N, 3] their shares in what a point takes from them.
    """

    points: Tensor
    normal: Tensor
    surface: Tensor
    first_neighbors: Tensor
    last_neighbors: Tensor
    near: Tensor
    near_weight: Tensor

    @staticmethod
    def of(points: Tensor, surface: Tensor, normal: Tensor, size: SurfaceSize) -> SurfaceCloud:
        """Of clouds [B, N, 3]; spin images and normals of the points that the first layer reads."""
        read, left = points[:, : size.read], points[:, : size.centers]
        # Shares by inverse distance, as in PointNet++; a point that is left takes all from itself.
        near = nearest_indices(points, left, 3)
        found = left.gather(1, near.flatten(1)[..., None].expand(-1, -1, 3)).unflatten(1, near.shape[1:])
        share = 1 / ((found - points[:, :, None]).square().sum(-1) + 1e-6)
        return SurfaceCloud(
            points - read.mean(1, keepdim=True),
            normal,
            surface,
            nearest_neighbors(read, size.num_neighbors).index[:, : size.centers],
            nearest_neighbors(left, size.num_neighbors).index,
            near,
            share / share.sum(-1, keepdim=True),
        )

    @staticmethod
    def of_points(points: Tensor, size: SurfaceSize) -> SurfaceCloud:
        """Of clouds [B, N, 3] whose surfaces are not looked at: it is known where points are, and no more."""
        nothing = points.new_zeros(*points[:, : size.read].shape[:2], 1)
        return SurfaceCloud.of(points, nothing.expand(-1, -1, SPIN_CHANNELS), nothing.expand(-1, -1, 3), size)

    def seen_in(self, frame: Tensor) -> SurfaceCloud:
        """Copies in frames [B, S, 3, 3] (frame -> camera): B S clouds, the copies of a cloud in a row."""
        copies = frame.shape[1]
        points, normal = (torch.einsum("bni,bsij->bsnj", x, frame).flatten(0, 1) for x in self[:2])
        return SurfaceCloud(points, normal, *(x.repeat_interleave(copies, dim=0) for x in self[2:]))

    def carried(
        self,
        local: Tensor,  # [B, M', C] of the points that are left
    ) -> Tensor:  # [B, N, C]
        """What every point takes from the nearest of them."""
        index = self.near.flatten(1)[..., None].expand(-1, -1, local.shape[-1])
        return (local.gather(1, index).unflatten(1, self.near.shape[1:]) * self.near_weight[..., None]).sum(2)

    def rows(self, key) -> SurfaceCloud:
        """Some of the clouds."""
        return SurfaceCloud(*(x[key] for x in self))


class SurfaceNetwork(nn.Module):
    """Kernel-point convolutions over spin images and normals, and features of the whole cloud."""

    def __init__(self, size: SurfaceSize) -> None:
        """Args: sizes."""
        super().__init__()
        self.radii = size.radii
        group = rotation_group(MODES)
        points = symmetric_kernel_points(group, size.num_kernel_points).points
        kernel = KernelPoints(points, torch.arange(len(points))[None])  # of the trivial group
        self.register_buffer("kernel_points", points.float(), persistent=False)
        first, last, dim = size.dims[0], size.dims[-1], size.head_dim
        self.surface = nn.Sequential(nn.Linear(SPIN_CHANNELS + 3, first), nn.LayerNorm(first), nn.LeakyReLU(0.1))
        channels = zip((first, *size.dims[:-1]), size.dims, strict=True)
        self.blocks = nn.ModuleList(GroupConvolutionBlock(*c, group, kernel, intra=False) for c in channels)
        self.pooled = nn.Sequential(*layer(first + last + 3, dim), nn.Linear(dim, size.global_dim))
        self.whole = nn.Sequential(*layer(2 * size.global_dim, dim))

    def describe(self, seen: SurfaceCloud) -> tuple[Tensor, Tensor]:  # [B, M', C], [B, D]
        """Features of the points that are left and of the whole, of clouds as they are seen in some frame."""
        count = seen.last_neighbors.shape[1]
        left = seen.points[:, :count]
        surface = self.surface(torch.cat([seen.surface, seen.normal], dim=-1))
        features = surface[:, :, None]
        neighbors = _neighbors(seen.points, seen.first_neighbors)
        for block, radius in zip(self.blocks, self.radii, strict=True):
            features = block(features, correlate(neighbors, radius, self.kernel_points))
            neighbors = _neighbors(left, seen.last_neighbors)
        local = torch.cat([surface[:, :count], features.squeeze(2)], dim=-1)
        pooled = self.pooled(torch.cat([local, left], dim=-1))
        # The mean counts what many points say a little, which relief is; the maximum finds what few points say.
        return local, self.whole(torch.cat([pooled.amax(1), functional.leaky_relu(pooled, 0.1).mean(1)], dim=-1))


def layer(inputs: int, outputs: int) -> tuple[nn.Module, ...]:
    """A layer of a perceptron: linear, normalised, and LeakyReLU."""
    return nn.Linear(inputs, outputs), nn.LayerNorm(outputs), nn.LeakyReLU(0.1)


def _neighbors(points: Tensor, index: Tensor) -> Neighbors:
    """Neighbours that are known already, of the leading ones of points [B, N, 3] in another frame."""
    coordinates = points.transpose(1, 2)
    found = coordinates.gather(2, index.flatten(1)[:, None].expand(-1, 3, -1)).unflatten(2, index.shape[1:])
    return Neighbors(index, found - coordinates[:, :, : index.shape[1], None], points.shape[1])
