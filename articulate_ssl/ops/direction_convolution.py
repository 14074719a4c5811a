"""Equivariant convolution of features on directions: depth-wise over space and directions, then over channels."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from articulate_ssl.ops.edges import Edges
from articulate_ssl.ops.neighborhood import Neighborhood
from articulate_ssl.ops.precision import fast_dtype

# Channels that a tile is wide, and features that it gathers.
_CHANNELS = {"cpu": 16, "cuda": 2**20}
_TILE_ELEMENTS = {"cpu": 2**19, "cuda": 2**26}


def direction_convolution(
    features: Tensor,  # [B, N, V, C]
    neighborhood: Neighborhood,
    spatial: Tensor,  # [O, C]
    mixing: Tensor,  # [C, C']
    orbit: Tensor,  # [V, K, V]
) -> Tensor:  # [B, M, V, C']
    """(F * h)(x_i, v) = sum_jku w(x_j - x_i, kappa_k) F(x_j, u) diag(s_orbit(v, k, u)) M, averaged over the ball.

    Features live on directions of the sphere instead of rotations (E2PN, Zhu et al. 2023,
    https://arxiv.org/abs/2206.05398). The kernel has one value per channel and orbit of (v, kappa_k, u) under the group
    (`kernel_orbits`): it sees how a neighbour and the neighbour's direction lie around v, and so tells mirror images
    apart. Autograd keeps the [B, M, V, C] depth-wise features, never the aggregate [B, M, K, V, C]. Under autocast the
    type is chosen as in `group_convolution`.
    """
    device = spatial.device
    dtype = fast_dtype(device) if torch.is_autocast_enabled(device.type) else spatial.dtype
    with torch.autocast(device.type, enabled=False):
        index, correlation = neighborhood.index, neighborhood.weight.to(dtype)
        filtered = _DepthwiseConvolution.apply(features.to(dtype), spatial.to(dtype), index, correlation, orbit)
        return filtered @ mixing.to(dtype)


def constant_direction_convolution(
    neighborhood: Neighborhood,
    weight: Tensor,  # [R, C']
    ring: Tensor,  # [V, K] orbits of (v, kappa_k)
) -> Tensor:  # [B, M, V, C']
    """Convolution of the constant feature one, which is the same in all directions."""
    device = weight.device
    dtype = fast_dtype(device) if torch.is_autocast_enabled(device.type) else weight.dtype
    with torch.autocast(device.type, enabled=False):
        total = neighborhood.weight.to(dtype).sum(dim=2)  # [B, M, K]
        kernel = weight.to(dtype)[ring.T].flatten(1)  # [K, V C']
        return (total @ kernel).unflatten(-1, (len(ring), -1))


class _DepthwiseConvolution(torch.autograd.Function):
    @staticmethod
    def forward(ctx, features, weight, index, correlation, orbit):
        ctx.save_for_backward(features, weight, index, correlation, orbit)
        V = features.shape[2]
        out = features.new_empty(*index.shape[:2], *features.shape[2:])
        edges = _edges(features, index, correlation)
        for channels in _channel_blocks(features):
            kernel = weight[:, channels].T[:, orbit].flatten(2)  # [c, V, K V]
            filtered = features.new_empty(len(edges.order), V, kernel.shape[0])
            for centers, aggregate in edges.aggregates(_block(features, channels)):
                filtered[centers] = (_by_channel(aggregate, V) @ kernel.transpose(1, 2)).permute(1, 2, 0)
            out[..., channels] = filtered[edges.rank].view_as(out[..., channels])
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_out):
        features, weight, index, correlation, orbit = ctx.saved_tensors
        V = features.shape[2]
        grad_features = torch.empty_like(features, memory_format=torch.contiguous_format)
        grad_weight = torch.zeros_like(weight, dtype=torch.promote_types(weight.dtype, torch.float32))
        # The transpose is a convolution along reversed edges; its aggregate gives both gradients.
        edges = _edges(features, index, correlation, reverse=True)
        reversed_orbit = orbit.permute(2, 1, 0)
        for channels in _channel_blocks(features):
            kernel = weight[:, channels].T[:, reversed_orbit].flatten(2)  # [c, V, K V]
            grad_kernel = torch.zeros_like(kernel, dtype=grad_weight.dtype)
            ordered = _block(features, channels)[edges.order].view(len(edges.order), V, -1)
            filtered = torch.empty_like(ordered)
            for points, aggregate in edges.aggregates(_block(grad_out, channels)):
                aggregate = _by_channel(aggregate, V)
                grad_kernel += ordered[points].permute(2, 1, 0) @ aggregate
                filtered[points] = (aggregate @ kernel.transpose(1, 2)).permute(1, 2, 0)
            grad_features[..., channels] = filtered[edges.rank].view_as(grad_features[..., channels])
            grad_weight[:, channels] = torch.zeros_like(grad_weight[:, channels]).index_add_(
                0, reversed_orbit.flatten(), grad_kernel.flatten(1).T
            )
        return grad_features, grad_weight.to(weight.dtype), None, None, None


def _edges(features: Tensor, index: Tensor, correlation: Tensor, reverse: bool = False) -> Edges:
    _, N, V, C = features.shape
    width = V * min(C, _CHANNELS[features.device.type])
    return Edges(index, correlation, N, width, _TILE_ELEMENTS[features.device.type], reverse)


def _channel_blocks(features: Tensor) -> Iterator[slice]:
    C, size = features.shape[-1], _CHANNELS[features.device.type]
    return (slice(c, min(c + size, C)) for c in range(0, C, size))


def _block(features: Tensor, channels: slice) -> Tensor:
    """[B N, V c] some channels."""
    return features[..., channels].flatten(2).flatten(0, 1)


def _by_channel(aggregate: Tensor, num_directions: int) -> Tensor:
    """[c, t, K V] the aggregate [t, K, V c], as the operand of a matrix product per channel."""
    return aggregate.unflatten(2, (num_directions, -1)).flatten(1, 2).permute(2, 0, 1).contiguous()
