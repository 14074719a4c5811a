"""Depth-wise separable group convolution: one spatial kernel per channel, then a mixing of the channels."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from articulate_ssl.ops.edges import Edges
from articulate_ssl.ops.neighborhood import Neighborhood
from articulate_ssl.ops.precision import fast_dtype

# Group elements times channels that a tile is wide, and features that it gathers: on a CPU both, and the aggregate,
# stay in the L2 cache and in buffers that every tile uses again; on a GPU each tile fills the machine.
_WIDTH = {"cpu": 256, "cuda": 2**20}
_TILE_ELEMENTS = {"cpu": 2**17, "cuda": 2**26}


def separable_group_convolution(
    features: Tensor,  # [B, N, G, C]
    neighborhood: Neighborhood,
    spatial: Tensor,  # [K, C]
    mixing: Tensor,  # [C, C']
    permutation: Tensor,  # [G, K]
) -> Tensor:  # [B, M, G, C']
    """`group_convolution` with the kernel W_k = diag(s_k) M: depth-wise over space, then point-wise over channels.

    Depth-wise separable convolution (Chollet 2017, https://arxiv.org/abs/1610.02357) on kernel points; equivariant as
    every kernel of `group_convolution` is. Autograd keeps the [B, M, G, C] depth-wise features, never the aggregate
    [B, M, G, C, K]. Under autocast the type is chosen as in `group_convolution`.
    """
    device = spatial.device
    dtype = fast_dtype(device) if torch.is_autocast_enabled(device.type) else spatial.dtype
    with torch.autocast(device.type, enabled=False):
        index, correlation = neighborhood.index, neighborhood.weight.to(dtype)
        filtered = _DepthwiseConvolution.apply(features.to(dtype), spatial.to(dtype), index, correlation, permutation)
        return filtered @ mixing.to(dtype)


class _DepthwiseConvolution(torch.autograd.Function):
    @staticmethod
    def forward(ctx, features, weight, index, correlation, permutation):
        ctx.save_for_backward(features, weight, index, correlation, permutation)
        out = features.new_empty(*index.shape[:2], *features.shape[2:])
        slot = permutation.argsort(dim=1)
        edges = _edges(features, index, correlation)
        for elements, block in _blocks(features):
            kernel = weight[slot[elements].T].flatten(1)  # [K, s C]
            filtered = block.new_empty(len(edges.order), block.shape[1])
            for centers, aggregate in edges.aggregates(block):
                torch.sum(aggregate.mul_(kernel), dim=1, out=filtered[centers])
            out[:, :, elements] = filtered[edges.rank].view_as(out[:, :, elements])
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_out):
        features, weight, index, correlation, permutation = ctx.saved_tensors
        grad_features = torch.empty_like(features, memory_format=torch.contiguous_format)
        grad_weight = torch.zeros_like(weight, dtype=torch.promote_types(weight.dtype, torch.float32))
        slot = permutation.argsort(dim=1)
        # The transpose of a depth-wise convolution is one along reversed edges; its aggregate gives both gradients.
        edges = _edges(features, index, correlation, reverse=True)
        for (elements, block), (_, grad) in zip(_blocks(features), _blocks(grad_out), strict=True):
            kernel = weight[slot[elements].T].flatten(1)
            grad_kernel = torch.zeros_like(kernel, dtype=grad_weight.dtype)
            ordered = block[edges.order]
            filtered = torch.empty_like(ordered)
            for points, aggregate in edges.aggregates(grad):
                grad_kernel += (aggregate * ordered[points, None]).sum(dim=0, dtype=grad_kernel.dtype)
                torch.sum(aggregate.mul_(kernel), dim=1, out=filtered[points])
            grad_features[:, :, elements] = filtered[edges.rank].view_as(grad_features[:, :, elements])
            grad_weight.index_add_(0, slot[elements].T.flatten(), grad_kernel.view(-1, weight.shape[1]))
        return grad_features, grad_weight.to(weight.dtype), None, None, None


def _blocks(features: Tensor) -> Iterator[tuple[slice, Tensor]]:
    """Some group elements at a time, and their features [B N, s C]."""
    size = _elements_per_block(features)
    for start in range(0, features.shape[2], size):
        elements = slice(start, min(start + size, features.shape[2]))
        yield elements, features[:, :, elements].flatten(2).flatten(0, 1)


def _elements_per_block(features: Tensor) -> int:
    _, _, G, C = features.shape
    return min(G, max(1, _WIDTH[features.device.type] // C))


def _edges(features: Tensor, index: Tensor, correlation: Tensor, reverse: bool = False) -> Edges:
    _, N, _, C = features.shape
    return Edges(
        index, correlation, N, _elements_per_block(features) * C, _TILE_ELEMENTS[features.device.type], reverse
    )
