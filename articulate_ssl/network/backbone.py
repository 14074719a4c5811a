"""The equivariant backbone: a stack of group convolutions (EPN, Chen et al. 2021; paper Sec. 3.1)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from articulate_ssl.geometry.directions import Directions, icosahedron_directions, kernel_orbits, kernel_rings
from articulate_ssl.geometry.kernel_points import KernelPoints, symmetric_kernel_points
from articulate_ssl.geometry.rotation_group import RotationGroup, rotation_group
from articulate_ssl.network.options import NetworkOptions
from articulate_ssl.network.pose_aware_convolution import canonicalize
from articulate_ssl.ops.direction_convolution import constant_direction_convolution, direction_convolution
from articulate_ssl.ops.group_convolution import group_convolution
from articulate_ssl.ops.neighborhood import Neighborhood, Neighbors, correlate, nearest_neighbors
from articulate_ssl.ops.normalization import layer_norm_leaky_relu
from articulate_ssl.ops.separable_group_convolution import separable_group_convolution


class IntraGroupConvolution(nn.Module):
    """Convolution over the rotation group by right multiplication: sum over h in H of F(x, g h) V_h (EPN).

    Right multiplication commutes with the left action. H holds the identity and the 11 elements of smallest angle.
    """

    def __init__(self, in_channels: int, out_channels: int, group: RotationGroup, num_elements: int = 12) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(num_elements, in_channels, out_channels))
        nn.init.normal_(self.weight, std=2 / (in_channels * num_elements + out_channels) ** 0.5)
        self.register_buffer("neighbor", group.product[:, :num_elements].T.contiguous(), persistent=False)

    def forward(
        self,
        features: Tensor,  # [B, M, G, C]
    ) -> Tensor:  # [B, M, G, C']
        # Projected before it is permuted: autograd then keeps one copy of the features instead of one per element.
        return sum(
            (features @ weight).index_select(2, index) for weight, index in zip(self.weight, self.neighbor, strict=True)
        )


class GroupConvolutionBlock(nn.Module):
    """Group convolution -> normalisation -> LeakyReLU; with `intra`, EPN's block.

    EPN's block adds an intra-group convolution and a skip connection, each with normalisation and LeakyReLU.
    With `separable`, the spatial kernel is depth-wise and followed by a mixing of the channels. A block of one input
    channel keeps the full kernel: it costs little, and depth-wise its features would be multiples of one number.
    Layer normalisation over the channels of each point and group element commutes with the action of the group and
    mixes neither points nor samples, so a cloud's features do not depend on the rest of its batch.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        group: RotationGroup,
        kernel: KernelPoints,
        intra: bool,
        separable: bool = False,
    ) -> None:
        super().__init__()
        num_points = len(kernel.points)
        self.separable = separable and in_channels > 1
        # Xavier for the fan-in of the whole kernel, with the gain of ReLU (as the original).
        std = 2 / (in_channels * num_points + out_channels) ** 0.5
        if self.separable:
            # The product has the full kernel's scale; spatial kernels of unit norm leave the features' scale as it is.
            self.spatial = nn.Parameter(torch.randn(num_points, in_channels) / num_points**0.5)
            self.mixing = nn.Parameter(torch.randn(in_channels, out_channels) * std * num_points**0.5)
        else:
            self.weight = nn.Parameter(torch.empty(num_points, in_channels, out_channels))
            nn.init.normal_(self.weight, std=std)
        self.norm = nn.LayerNorm(out_channels)
        self.register_buffer("permutation", kernel.permutation, persistent=False)
        self.intra = self.skip = None
        if intra:
            self.intra = nn.Sequential(
                IntraGroupConvolution(out_channels, out_channels, group), nn.LayerNorm(out_channels), nn.LeakyReLU()
            )
            self.skip = nn.Sequential(nn.Linear(in_channels, out_channels), nn.LayerNorm(out_channels), nn.LeakyReLU())

    def forward(
        self,
        features: Tensor | None,  # [B, N, G, C], or None for the constant one
        neighborhood: Neighborhood,  # its M centres are the leading points
    ) -> Tensor:  # [B, M, G, C']
        out = self.convolve(features, neighborhood)
        out = layer_norm_leaky_relu(out, self.norm.weight, self.norm.bias, 0.01, self.norm.eps)
        if self.intra is None:
            return out
        B, M, G, _ = out.shape
        center = out.new_ones(B, M, G, 1) if features is None else features[:, :M]
        return self.intra(out) + self.skip(center)

    def convolve(
        self,
        features: Tensor | None,  # [B, N, G, C], or None for the constant one
        neighborhood: Neighborhood,
    ) -> Tensor:  # [B, M, G, C']
        """The group convolution alone."""
        if self.separable:
            return separable_group_convolution(features, neighborhood, self.spatial, self.mixing, self.permutation)
        return group_convolution(features, neighborhood, self.weight, self.permutation)


class DirectionConvolutionBlock(nn.Module):
    """Direction convolution -> normalisation -> LeakyReLU. The one input channel of a first block is constant."""

    def __init__(self, in_channels: int, out_channels: int, directions: Directions, kernel: KernelPoints) -> None:
        super().__init__()
        num_points = len(kernel.points)
        # Scales as in `GroupConvolutionBlock`.
        std = 2 / (in_channels * num_points + out_channels) ** 0.5
        orbit = kernel_rings(directions, kernel) if in_channels == 1 else kernel_orbits(directions, kernel)
        num_orbits = int(orbit.max()) + 1
        if in_channels == 1:
            self.weight = nn.Parameter(torch.randn(num_orbits, out_channels) * std)
        else:
            self.spatial = nn.Parameter(torch.randn(num_orbits, in_channels) / orbit[0].numel() ** 0.5)
            self.mixing = nn.Parameter(torch.randn(in_channels, out_channels) * std * num_points**0.5)
        self.norm = nn.LayerNorm(out_channels)
        self.register_buffer("orbit", orbit, persistent=False)

    def forward(
        self,
        features: Tensor | None,  # [B, N, V, C], or None for the constant one
        neighborhood: Neighborhood,  # its M centres are the leading points
    ) -> Tensor:  # [B, M, V, C']
        if features is None:
            out = constant_direction_convolution(neighborhood, self.weight, self.orbit)
        else:
            out = direction_convolution(features, neighborhood, self.spatial, self.mixing, self.orbit)
        return layer_norm_leaky_relu(out, self.norm.weight, self.norm.bias, 0.01, self.norm.eps)


class EquivariantBackbone(nn.Module):
    """Features of every point and group element, equivariant under the group and invariant to translation.

    Args:
        group_order: 12, 24 or 60.
        dims: channels of each layer's output.
        radii: ball radius of each layer; the rest-state bounding-box diagonal of the object is 1.
        num_neighbors: at most this many nearest points per ball.
        num_kernel_points: see `symmetric_kernel_points`.
        num_centers: for each layer, how many leading points remain (points come in farthest-point order, so a prefix
            covers the cloud); None keeps all of them everywhere.
        intra: let the group's elements communicate in every layer (EPN's block).
        separable: depth-wise spatial kernels followed by a mixing of channels, in every layer but the first.
        directions: features on the 12 directions of the icosahedron instead of the 60 rotations of its group, with
            kernels that are separable; the third axis of the result counts directions.

    Raises:
        ValueError: if `dims`, `radii` and `num_centers` differ in length, or `directions` are asked for with another
            group than the icosahedral one, or with `intra`, which is a convolution over the group.
    """

    group: RotationGroup

    def __init__(
        self,
        group_order: int = 60,
        dims: Sequence[int] = (64, 128, 512),
        radii: Sequence[float] = (0.08, 0.16, 0.2263),
        num_neighbors: int = 64,
        num_kernel_points: int = 24,
        num_centers: Sequence[int] | None = None,
        intra: bool = False,
        separable: bool = False,
        directions: bool = False,
    ) -> None:
        super().__init__()
        if len(radii) != len(dims) or (num_centers is not None and len(num_centers) != len(dims)):
            raise ValueError(
                f"dims, radii and num_centers state one value per layer, got {dims}, {radii}, {num_centers}"
            )
        self.group = rotation_group(group_order)
        self.radii = tuple(radii)
        self.num_neighbors = num_neighbors
        self.num_centers = None if num_centers is None else tuple(num_centers)
        self.out_channels = dims[-1]
        kernel = symmetric_kernel_points(self.group, num_kernel_points)
        self.register_buffer("kernel_points", kernel.points, persistent=False)
        if directions and intra:
            raise ValueError("intra is a convolution over the group: features on directions have no use for it")
        channels = list(zip((1, *dims[:-1]), dims, strict=True))
        if directions:
            table = icosahedron_directions(self.group)
            self.blocks = nn.ModuleList(DirectionConvolutionBlock(*c, table, kernel) for c in channels)
        else:
            self.blocks = nn.ModuleList(
                GroupConvolutionBlock(*c, self.group, kernel, intra, separable) for c in channels
            )

    @staticmethod
    def of(options: NetworkOptions) -> EquivariantBackbone:
        """The backbone that a configuration asks for."""
        return EquivariantBackbone(
            options.group_order,
            options.dims,
            options.radii,
            options.num_neighbors,
            options.num_kernel_points,
            options.num_centers,
            intra=options.intra,
            separable=options.separable,
            directions=options.directions,
        )

    def neighborhoods(
        self,
        points: Tensor,  # [B, N, 3]
    ) -> list[Neighborhood]:
        """The geometry of every layer; layers that see the same points share one neighbour search."""
        B, N = points.shape[:2]
        found: dict[int, Neighbors] = {}
        neighborhoods = []
        for layer, radius in enumerate(self.radii):
            M = N if self.num_centers is None else min(N, self.num_centers[layer])
            if N not in found:
                # Centres only get fewer: the search of the first layer that sees these points serves the later ones.
                centers = None if M == N else torch.arange(M, device=points.device).expand(B, M)
                found[N] = nearest_neighbors(points[:, :N], self.num_neighbors, centers)
            neighborhoods.append(correlate(found[N].leading(M), radius, self.kernel_points))
            N = M
        return neighborhoods

    def forward(
        self,
        points: Tensor,  # [B, N, 3]
        poses: Tensor | None = None,  # [B, N, 4, 4] canonical -> camera space, of each point's part
    ) -> Tensor:  # [B, M, G, C], or [B, M, V, C] on directions
        """Features in the frame of `points`, or with `poses` pose-aware features in the canonical frame.

        Pose-aware convolution is plain convolution of the cloud with every part moved back to canonical space
        (`pose_aware_convolution`).
        """
        if poses is not None:
            points = canonicalize(points, poses)
        features = None
        for block, neighborhood in zip(self.blocks, self.neighborhoods(points), strict=True):
            features = block(features, neighborhood)
        return features
