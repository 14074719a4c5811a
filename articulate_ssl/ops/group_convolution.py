"""Group-equivariant point convolution, aggregated in tiles that stay in cache."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import embedding_bag

from articulate_ssl.ops.neighborhood import Neighborhood
from articulate_ssl.ops.precision import fast_dtype

# Gathered features per tile: on a CPU they stay in cache and in memory that malloc recycles (fresh pages cost more than
# the arithmetic); on a GPU each tile fills the machine.
_TILE_ELEMENTS = {"cpu": 2**19, "cuda": 2**26}


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

    The [B, M, G, C, K] aggregate is never held whole: it is built tile by tile, and again in the backward pass.
    Gradients reach `features` and `weight`; the geometry is constant. Under autocast the products run, and the result
    is, in the autocast type where the device multiplies it faster than float32.
    """
    device = weight.device
    dtype = fast_dtype(device) if torch.is_autocast_enabled(device.type) else weight.dtype
    with torch.autocast(device.type, enabled=False):
        weight, neighborhood = weight.to(dtype), neighborhood.to(dtype)
        if features is None:
            return _constant_input(neighborhood, weight, permutation)
        return _GroupConvolution.apply(features.to(dtype), weight, neighborhood.index, neighborhood.weight, permutation)


def _constant_input(neighborhood: Neighborhood, weight: Tensor, permutation: Tensor) -> Tensor:
    """Convolution of the constant feature one: the aggregate is the sum of the correlation weights."""
    total = neighborhood.weight.sum(dim=2)  # [B, M, K]
    kernel = weight[permutation.argsort(dim=1), 0]  # [G, K, C']
    return (total @ kernel.transpose(0, 1).flatten(1)).unflatten(-1, (len(permutation), -1))


class _GroupConvolution(torch.autograd.Function):
    @staticmethod
    def forward(ctx, features, weight, index, correlation, permutation):
        ctx.save_for_backward(features, weight, index, correlation, permutation)
        tiling = _Tiling(features, weight, index, correlation, permutation)
        out = features.new_empty(tiling.B * tiling.M, tiling.G, weight.shape[2])
        for elements in tiling.element_blocks():
            kernel = tiling.kernel(elements)
            block = tiling.block(elements)
            for samples in tiling.sample_blocks():
                aggregate = tiling.aggregate(block, samples)
                torch.bmm(aggregate, kernel, out=out[tiling.rows(samples), elements].transpose(0, 1))
        return out.view(tiling.B, tiling.M, tiling.G, -1)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_out):
        features, weight, index, correlation, permutation = ctx.saved_tensors
        tiling = _Tiling(features, weight, index, correlation, permutation)
        grad_out = grad_out.flatten(0, 1)
        grad_features = torch.empty_like(features, memory_format=torch.contiguous_format)
        grad_weight = weight.new_zeros(
            tiling.C, tiling.K, weight.shape[2], dtype=torch.promote_types(weight.dtype, torch.float32)
        )
        with torch.autocast(weight.device.type, enabled=False):
            for elements in tiling.element_blocks():
                kernel = tiling.kernel(elements)
                block = tiling.block(elements)
                grad_kernel = torch.zeros_like(kernel)
                for samples in tiling.sample_blocks():
                    grad = grad_out[tiling.rows(samples), elements].transpose(0, 1)  # [s, b M, C']
                    grad_kernel.baddbmm_(tiling.aggregate(block, samples).transpose(1, 2), grad)
                    grad_aggregate = tiling.grad_aggregate(grad, kernel)
                    grad_features[samples, :, elements] = tiling.scatter(grad_aggregate, samples)
                for g, grad_element in zip(range(tiling.G)[elements], grad_kernel, strict=True):
                    grad_weight += grad_element.view_as(grad_weight)[:, permutation[g]]
        return grad_features, grad_weight.transpose(0, 1).to(weight.dtype), None, None, None


class _Tiling:
    """The aggregate of some samples and group elements at a time, in buffers that every tile uses again.

    Layout: aggregates and kernels have the flat axis (c, k'), k' counting the unrotated kernel points, so that a block
    of aggregates is one operand of a matrix product without a copy; row permutation[g, k] of element g's kernel is W_k.
    """

    def __init__(
        self, features: Tensor, weight: Tensor, index: Tensor, correlation: Tensor, permutation: Tensor
    ) -> None:
        self.B, self.N, self.G, self.C = features.shape
        _, self.M, self.n, self.K = correlation.shape
        self.features, self.weight, self.index = features, weight, index
        self.correlation = correlation.flatten(0, 1)  # [B M, n, K]
        self.slot = permutation.argsort(dim=1)
        start = torch.arange(self.B, device=index.device) * self.N
        self.flat_index = (index + start[:, None, None]).flatten()
        # The tile: as many group elements as fit, in blocks of even size, then as many samples.
        budget = _TILE_ELEMENTS[features.device.type]
        per_element = self.M * self.n * self.C
        num_blocks = math.ceil(self.G / max(1, budget // per_element))
        self.s = math.ceil(self.G / num_blocks)
        self.b = min(self.B, max(1, budget // (per_element * self.s)))
        self._gathered = features.new_empty(self.b * self.s * per_element)
        self._aggregate = features.new_empty(self.b * self.M * self.s * self.C * self.K)
        self._grad_aggregate: Tensor | None = None
        self._bags: tuple[Tensor, Tensor] | None = None

    def element_blocks(self) -> Iterator[slice]:
        return (slice(g, min(g + self.s, self.G)) for g in range(0, self.G, self.s))

    def sample_blocks(self) -> Iterator[slice]:
        return (slice(b, min(b + self.b, self.B)) for b in range(0, self.B, self.b))

    def rows(self, samples: slice) -> slice:
        """The samples' rows among all B M outputs."""
        return slice(samples.start * self.M, samples.stop * self.M)

    def kernel(self, elements: slice) -> Tensor:
        """[s, C K, C'] weights of the group elements."""
        return self.weight.transpose(0, 1)[:, self.slot[elements]].transpose(0, 1).flatten(1, 2)

    def block(self, elements: slice) -> Tensor:
        """[B N, s C] features of the group elements."""
        return self.features[:, :, elements].reshape(self.B * self.N, -1)

    def aggregate(self, block: Tensor, samples: slice) -> Tensor:
        """[s, b M, C K] correlation-weighted sum of the neighbours' features."""
        rows, width = self.rows(samples), block.shape[1]
        count = rows.stop - rows.start
        gathered = self._gathered[: count * self.n * width].view(-1, width)
        torch.index_select(block, 0, self.flat_index[rows.start * self.n : rows.stop * self.n], out=gathered)
        aggregate = self._aggregate[: count * width * self.K].view(count, width, self.K)
        torch.bmm(gathered.view(count, self.n, width).transpose(1, 2), self.correlation[rows], out=aggregate)
        return aggregate.view(count, -1, self.C * self.K).transpose(0, 1)

    def grad_aggregate(self, grad: Tensor, kernel: Tensor) -> Tensor:
        """[b M, s C, K] gradient of the aggregate from that of the output."""
        if self._grad_aggregate is None:
            self._grad_aggregate = torch.empty_like(self._aggregate)
        s, count, _ = grad.shape
        out = self._grad_aggregate[: s * count * self.C * self.K].view(count, s, self.C * self.K)
        torch.bmm(grad, kernel.transpose(1, 2), out=out.transpose(0, 1))
        return out.view(count, s * self.C, self.K)

    def scatter(self, grad_aggregate: Tensor, samples: slice) -> Tensor:
        """[b, N, s, C] gradient of the features: the transpose of `aggregate`, summed in a fixed order."""
        count, width, _ = grad_aggregate.shape
        grad_gathered = self._gathered[: count * self.n * width].view(count, self.n, width)
        torch.bmm(self.correlation[self.rows(samples)], grad_aggregate.transpose(1, 2), out=grad_gathered)
        if self._bags is None:
            sorted_index, order = self.index.flatten(1).sort(dim=1, stable=True)
            points = torch.arange(self.N, device=order.device).expand(self.B, -1)
            self._bags = order, torch.searchsorted(sorted_index, points.contiguous())
        order, start = self._bags
        b = samples.stop - samples.start
        offset = torch.arange(b, device=order.device)[:, None] * (self.M * self.n)
        bags = (order[samples] + offset).flatten(), (start[samples] + offset).flatten()
        summed = embedding_bag(bags[0], grad_gathered.flatten(0, 1), bags[1], mode="sum")
        return summed.view(b, self.N, -1, self.C)
