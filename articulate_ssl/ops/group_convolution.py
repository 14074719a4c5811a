"""Group-equivariant point convolution, aggregated in tiles that stay in cache."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from articulate_ssl.ops.neighborhood import Neighborhood

# Elements of a tile's gathered features: small enough to stay in cache and below malloc's threshold for fresh pages.
_TILE_ELEMENTS = {"cpu": 2**21, "cuda": 2**28}


def group_convolution(
    features: Tensor | None,  # [B, N, G, C], or None for the constant one with C = 1
    neighborhood: Neighborhood,
    weight: Tensor,  # [K, C, C']
    permutation: Tensor,  # [G, K]
) -> Tensor:  # [B, M, G, C']
    """(F * h)(x_i, g) = sum_j sum_k w(x_j - x_i, A_g kappa_k) F(x_j, g) W_k, averaged over the ball (paper Sec. 3.1).

    Convention:
        The kernel points are closed under the group, so A_g only permutes them and the correlation weights w are those
        of the unrotated kernel. Rotating the cloud by element a moves feature index g to `product[a, g]`.

    The [B, M, K, G, C] aggregate is never held whole: it is built tile by tile, and again in the backward pass.
    Gradients reach `features` and `weight`; the geometry is constant.
    """
    if features is None:
        return _constant_input(neighborhood, weight, permutation)
    return _GroupConvolution.apply(features, weight, neighborhood.index, neighborhood.weight, permutation)


def _constant_input(neighborhood: Neighborhood, weight: Tensor, permutation: Tensor) -> Tensor:
    """Convolution of the constant feature one: the aggregate is the sum of the correlation weights."""
    total = neighborhood.weight.sum(dim=-1)  # [B, M, K]
    return total[:, :, permutation] @ weight[:, 0]  # [B, M, G, K] @ [K, C']


class _GroupConvolution(torch.autograd.Function):
    @staticmethod
    def forward(ctx, features, weight, index, correlation, permutation):
        ctx.save_for_backward(features, weight, index, correlation, permutation)
        kernel = _kernel_per_element(weight, permutation)
        out = features.new_empty(features.shape[0], index.shape[1], features.shape[2], weight.shape[2])
        for samples, group in _tiles(features, index):
            aggregate = _aggregate(features[samples, :, group], index[samples], correlation[samples])
            out[samples, :, group] = _project(aggregate, kernel[group]).view_as(out[samples, :, group])
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_out):
        features, weight, index, correlation, permutation = ctx.saved_tensors
        kernel = _kernel_per_element(weight, permutation)
        K, C, D = weight.shape
        grad_kernel = torch.zeros_like(kernel)
        grad_features = torch.empty_like(features)
        N = features.shape[1]
        for samples, group in _tiles(features, index):
            block = features[samples, :, group]
            grad_block = grad_out[samples, :, group].flatten(0, 1).transpose(0, 1)  # [s, bM, C']
            aggregate = _aggregate(block, index[samples], correlation[samples])
            grad_kernel[group].baddbmm_(aggregate.permute(1, 2, 0), grad_block)
            if ctx.needs_input_grad[0]:
                grad_aggregate = torch.bmm(grad_block, kernel[group].transpose(1, 2))  # [s, bM, C K]
                grad_features[samples, :, group] = _scatter(
                    grad_aggregate.transpose(0, 1), index[samples], correlation[samples], N
                )
        grad_weight = None
        if ctx.needs_input_grad[1]:
            inverse = permutation.argsort(dim=1)  # the kernel slot of each kernel point
            grad_weight = torch.zeros_like(weight)
            grad_weight.index_add_(
                0, inverse.flatten(), grad_kernel.view(-1, C, K, D).transpose(1, 2).reshape(-1, C, D)
            )
        return grad_features, grad_weight, None, None, None


def _kernel_per_element(weight: Tensor, permutation: Tensor) -> Tensor:
    """[G, C K, C'] weights ordered as the unrotated kernel points: row (c, permutation[g, k]) holds W_k[c]."""
    inverse = permutation.argsort(dim=1)
    return weight.transpose(0, 1)[:, inverse].transpose(0, 1).flatten(1, 2)


def _tiles(features: Tensor, index: Tensor) -> Iterator[tuple[slice, slice]]:
    """Samples and group elements of each tile."""
    B, _, G, C = features.shape
    per_element = index.shape[1] * index.shape[2] * C
    budget = _TILE_ELEMENTS[features.device.type]
    elements = min(G, max(1, budget // per_element))
    samples = min(B, max(1, budget // (per_element * elements)))
    for b in range(0, B, samples):
        for g in range(0, G, elements):
            yield slice(b, b + samples), slice(g, g + elements)


def _flat(index: Tensor, num_points: int) -> Tensor:
    """[b M n] indices into the points of all samples of a tile."""
    start = torch.arange(index.shape[0], device=index.device) * num_points
    return (index + start[:, None, None]).flatten()


def _aggregate(block: Tensor, index: Tensor, correlation: Tensor) -> Tensor:
    """[b M, s, C K] correlation-weighted sum of the neighbours' features."""
    b, N, s, C = block.shape
    K, n = correlation.shape[2:]
    gathered = block.reshape(b * N, s * C).index_select(0, _flat(index, N)).view(-1, n, s * C)
    aggregate = torch.bmm(gathered.transpose(1, 2), correlation.view(-1, K, n).transpose(1, 2))  # [b M, s C, K]
    return aggregate.view(-1, s, C * K)


def _project(aggregate: Tensor, kernel: Tensor) -> Tensor:
    """[b M, s, C'] product with every element's weights."""
    return torch.bmm(aggregate.transpose(0, 1), kernel).transpose(0, 1)


def _scatter(grad_aggregate: Tensor, index: Tensor, correlation: Tensor, num_points: int) -> Tensor:
    """[b, N, s, C] gradient of the features, the transpose of `_aggregate`."""
    b = index.shape[0]
    K, n = correlation.shape[2:]
    s = grad_aggregate.shape[1]
    grad = grad_aggregate.reshape(-1, grad_aggregate.shape[1] * grad_aggregate.shape[2] // K, K)  # [b M, s C, K]
    per_neighbor = torch.bmm(correlation.view(-1, K, n).transpose(1, 2), grad.transpose(1, 2))  # [b M, n, s C]
    flat = _flat(index, num_points)
    sorted_index, order = flat.sort(stable=True)
    start = torch.searchsorted(sorted_index, torch.arange(b * num_points, device=flat.device))
    summed = torch.nn.functional.embedding_bag(order, per_neighbor.flatten(0, 1), start, mode="sum")
    return summed.view(b, num_points, s, -1)
