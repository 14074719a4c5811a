"""Group convolution on a GPU: every point is a neighbour, most of them of weight zero, so that none is gathered.

A GPU multiplies matrices far faster than it copies rows of features to where they are multiplied: at the paper's size
(512 points, of which 64 are neighbours) gathering took 61 % of a prediction on an H200, and eight times as many
products take less (docs/benchmarks.md). The sum over neighbours is a product with the correlation weights of all
points, and its gradient one with their transpose: nothing is scattered either.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

_MOST_POINTS = 16  # per neighbour: with more, the products take longer than the copies
# Features that one sample gathers: with fewer, starting kernels is all that counts on a GPU. Never on a CPU.
_LEAST_GATHERED = {"cpu": 2**62, "cuda": 2**23}
_BLOCK_ELEMENTS = {"cpu": 2**19, "cuda": 2**28}  # of the aggregate that is held at a time


def is_faster_dense(features: Tensor, correlation: Tensor) -> bool:
    """Whether `DenseGroupConvolution` is the faster of the two: on a GPU, for large but not too many features."""
    _, N, G, C = features.shape
    _, M, n, _ = correlation.shape
    return _MOST_POINTS * n >= N and M * n * G * C >= _LEAST_GATHERED[features.device.type]


class DenseGroupConvolution(torch.autograd.Function):
    """Of features [B, N, G, C], weight [K, C, C'], index [B, M, n], correlation [B, M, n, K], permutation [G, K].

    The aggregate [G, b, M, K C] of some samples is an operand of the second product as the first one wrote it. It is
    built again in the backward pass.
    """

    @staticmethod
    def forward(ctx, features, weight, index, correlation, permutation):
        ctx.save_for_backward(features, weight, index, correlation, permutation)
        (B, _, G, _), M = features.shape, index.shape[1]
        kernel = _kernel(weight, permutation)
        out = features.new_empty(B, M, G, weight.shape[2])
        for samples, spread in _blocks(features, index, correlation):
            aggregate = _aggregate(features[samples], spread, len(weight))
            torch.bmm(aggregate, kernel, out=out[samples].flatten(0, 1).transpose(0, 1))
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_out):
        features, weight, index, correlation, permutation = ctx.saved_tensors
        C = weight.shape[1]
        kernel = _kernel(weight, permutation)
        grad_features = torch.empty_like(features, memory_format=torch.contiguous_format)
        grad_kernel = torch.zeros_like(kernel)
        grad_out = grad_out.contiguous()
        with torch.autocast(weight.device.type, enabled=False):
            for samples, spread in _blocks(features, index, correlation):
                grad = grad_out[samples].flatten(0, 1).transpose(0, 1)  # [G, b M, C']
                aggregate = _aggregate(features[samples], spread, len(weight))
                grad_kernel.baddbmm_(aggregate.transpose(1, 2), grad)
                torch.bmm(grad, kernel.transpose(1, 2), out=aggregate)  # the gradient takes the aggregate's place
                per_sample = aggregate.view(len(kernel), len(spread), -1, C)  # [G, b, M K, C]
                for i, of_points in enumerate(spread):
                    torch.bmm(
                        of_points.t().expand(len(kernel), -1, -1),
                        per_sample[:, i],
                        out=grad_features[samples.start + i].transpose(0, 1),
                    )
        # The rotated kernels are the same weights in another order.
        element = torch.arange(len(kernel), device=permutation.device)[:, None]
        of_weight = grad_kernel.view(-1, *weight.shape)[element, permutation]  # [G, K, C, C']
        grad_weight = of_weight.sum(0, dtype=torch.promote_types(weight.dtype, torch.float32))
        return grad_features, grad_weight.to(weight.dtype), None, None, None


def _kernel(weight: Tensor, permutation: Tensor) -> Tensor:  # [G, K C, C']
    """Weights of every group element, by unrotated kernel point."""
    return weight[permutation.argsort(dim=1)].flatten(1, 2)


def _blocks(features: Tensor, index: Tensor, correlation: Tensor) -> Iterator[tuple[slice, Tensor]]:
    """Some samples at a time, with the weights [b, M K, N] of all points for their centres."""
    B, N, G, C = features.shape
    M, K = correlation.shape[1], correlation.shape[3]
    size = max(1, _BLOCK_ELEMENTS[features.device.type] // (G * M * K * C))
    for start in range(0, B, size):
        samples = slice(start, min(start + size, B))
        neighbor = index[samples, :, None].expand(-1, -1, K, -1)
        # A neighbour comes once; only points outside the ball, of weight zero, might come again.
        spread = correlation.new_zeros(samples.stop - start, M, K, N)
        spread.scatter_add_(3, neighbor, correlation[samples].transpose(2, 3))
        yield samples, spread.flatten(1, 2)


def _aggregate(features: Tensor, spread: Tensor, num_kernel_points: int) -> Tensor:  # [G, b M, K C]
    """Sum over all points of their features [b, N, G, C] times their weights [b, M K, N]."""
    b, _, G, C = features.shape
    aggregate = features.new_empty(G, b, spread.shape[1], C)
    for i, of_points in enumerate(spread):
        torch.bmm(of_points.expand(G, -1, -1), features[i].transpose(0, 1), out=aggregate[:, i])
    return aggregate.view(G, -1, num_kernel_points * C)
