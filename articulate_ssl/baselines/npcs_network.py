"""The network of NPCS: kernel-point convolutions of a cloud as it is seen in some frame, and heads.

A group convolution without intra-group convolution computes the features at group element g from those at g alone: they
are an ordinary kernel-point convolution of the cloud turned by g^-1 (a test holds it against `GroupConvolutionBlock` of
the icosahedral group). So the features of a rotation mode are those of a turned copy of the cloud, and a network that
sees one copy only is a KPConv with rigid kernels (Thomas et al. 2019).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import roma
import torch
from torch import Tensor, nn
from torch.nn import functional

from articulate_ssl.baselines.spin_images import SPIN_CHANNELS
from articulate_ssl.geometry.kernel_points import KernelPoints, symmetric_kernel_points
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.network.backbone import GroupConvolutionBlock
from articulate_ssl.ops.neighborhood import Neighbors, correlate, nearest_neighbors

MODES = 60
_START_WEIGHT = 1e-2


@dataclass(frozen=True)
class NetworkSize:
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


class Geometry(NamedTuple):
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
    def of(points: Tensor, surface: Tensor, normal: Tensor, size: NetworkSize) -> Geometry:
        """Of clouds [B, N, 3]; spin images and normals of the points that the first layer reads."""
        read, left = points[:, : size.read], points[:, : size.centers]
        # Shares by inverse distance, as in PointNet++; a point that is left takes all from itself.
        square, near = torch.cdist(points, left).square().topk(min(3, left.shape[1]), largest=False)
        share = 1 / (square + 1e-6)
        return Geometry(
            points - read.mean(1, keepdim=True),
            normal,
            surface,
            nearest_neighbors(read, size.num_neighbors).index[:, : size.centers],
            nearest_neighbors(left, size.num_neighbors).index,
            near,
            share / share.sum(-1, keepdim=True),
        )

    def seen_in(self, frame: Tensor) -> Geometry:
        """Copies in frames [B, S, 3, 3] (frame -> camera): B S clouds, the copies of a cloud in a row."""
        copies = frame.shape[1]
        points, normal = (torch.einsum("bni,bsij->bsnj", x, frame).flatten(0, 1) for x in self[:2])
        return Geometry(points, normal, *(x.repeat_interleave(copies, dim=0) for x in self[2:]))

    def rows(self, key) -> Geometry:
        """Some of the clouds."""
        return Geometry(*(x[key] for x in self))


class WholeShape(NamedTuple):
    """What the network says about clouds seen in some frame, before it looks at single points.

    Attributes:
        mode: [B] logit that the frame is near the canonical one.
        rotation: [B, K, 3, 3] part space -> the frame.
        shift: [B, K, 3] what to add to points in a part's axes to have them about the part's centre.
        center: [B, K, 3] part centres in the object's rest-state frame.
        axis: [B, J, 3] unit, in the axes of part spaces.
        pivot: [B, J, 3] on the joint line at rest, about the parent's centre.
        local: [B, M', C] features of the points that are left.
        whole: [B, D].
    """

    mode: Tensor
    rotation: Tensor
    shift: Tensor
    center: Tensor
    axis: Tensor
    pivot: Tensor
    local: Tensor
    whole: Tensor

    def rows(self, key) -> WholeShape:
        """Some of the clouds."""
        return WholeShape(*(x[key] for x in self))


class CoordinateNetwork(nn.Module):
    """Kernel-point convolutions, whole-shape features, and heads for mode, poses, joints, parts and coordinates."""

    def __init__(self, num_parts: int, size: NetworkSize) -> None:
        """Args: K; sizes."""
        super().__init__()
        self.num_parts, self.radii = num_parts, size.radii
        group = rotation_group(MODES)
        points = symmetric_kernel_points(group, size.num_kernel_points).points
        kernel = KernelPoints(points, torch.arange(len(points))[None])  # of the trivial group
        self.register_buffer("kernel_points", points.float(), persistent=False)
        first, last, dim = size.dims[0], size.dims[-1], size.head_dim
        self.surface = nn.Sequential(nn.Linear(SPIN_CHANNELS + 3, first), nn.LayerNorm(first), nn.LeakyReLU(0.1))
        channels = zip((first, *size.dims[:-1]), size.dims, strict=True)
        self.blocks = nn.ModuleList(GroupConvolutionBlock(*c, group, kernel, intra=False) for c in channels)
        self.pooled = nn.Sequential(*_layer(first + last + 3, dim), nn.Linear(dim, size.global_dim))
        self.whole = nn.Sequential(*_layer(2 * size.global_dim, dim))
        self.mode = nn.Linear(dim, 1)
        self.pose = nn.Linear(dim, 9 * num_parts)
        self.structure = nn.Linear(dim, 3 * num_parts + 6 * (num_parts - 1))
        self.point = nn.Sequential(*_layer(first + last + 3 + dim, dim), *_layer(dim, dim))
        self.part_and_coordinates = nn.Linear(dim, 4 * num_parts)
        # A new network says that parts are turned as the frame is, and corrects nothing.
        for head in (self.pose, self.part_and_coordinates):
            nn.init.normal_(head.weight, std=_START_WEIGHT)
            nn.init.zeros_(head.bias)

    def look(self, seen: Geometry) -> WholeShape:
        """Of whole clouds as they are seen in some frame."""
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
        whole = self.whole(torch.cat([pooled.amax(1), functional.leaky_relu(pooled, 0.1).mean(1)], dim=-1))
        K = self.num_parts
        pose = self.pose(whole).unflatten(-1, (K, 9))
        columns = pose[..., :6].unflatten(-1, (3, 2)) + torch.eye(3, 2, dtype=pose.dtype, device=pose.device)
        center, axis, pivot = self.structure(whole).split([3 * K, 3 * K - 3, 3 * K - 3], dim=-1)
        return WholeShape(
            mode=self.mode(whole).squeeze(-1),
            rotation=roma.special_gramschmidt(columns),
            shift=pose[..., 6:],
            center=center.unflatten(-1, (K, 3)),
            axis=functional.normalize(axis.unflatten(-1, (K - 1, 3)), dim=-1),
            pivot=pivot.unflatten(-1, (K - 1, 3)),
            local=local,
            whole=whole,
        )

    def coordinates(self, seen: Geometry, said: WholeShape) -> tuple[Tensor, Tensor]:  # [B, N, K], [B, K, N, 3]
        """Part logits of all points, and their coordinates in every part's space.

        Points in the axes of a part are its coordinates up to a shift, so that a perceptron need not learn to multiply
        by rotations: it corrects what the whole shape says.
        """
        B, N, _ = seen.points.shape
        index = seen.near.flatten(1)[..., None].expand(-1, -1, said.local.shape[-1])
        carried = (said.local.gather(1, index).unflatten(1, (N, -1)) * seen.near_weight[..., None]).sum(2)
        whole = said.whole[:, None].expand(-1, N, -1)
        out = self.part_and_coordinates(self.point(torch.cat([carried, seen.points, whole], dim=-1)))
        logits, correction = out.split([self.num_parts, 3 * self.num_parts], dim=-1)
        turned = torch.einsum("bni,bkij->bknj", seen.points, said.rotation)
        return logits, turned + said.shift[:, :, None] + correction.view(B, N, -1, 3).transpose(1, 2)


def _layer(inputs: int, outputs: int) -> tuple[nn.Module, ...]:
    return nn.Linear(inputs, outputs), nn.LayerNorm(outputs), nn.LeakyReLU(0.1)


def _neighbors(points: Tensor, index: Tensor) -> Neighbors:
    """Neighbours that are known already, of the leading ones of points [B, N, 3] in another frame."""
    coordinates = points.transpose(1, 2)
    found = coordinates.gather(2, index.flatten(1)[:, None].expand(-1, 3, -1)).unflatten(2, index.shape[1:])
    return Neighbors(index, found - coordinates[:, :, : index.shape[1], None], points.shape[1])
