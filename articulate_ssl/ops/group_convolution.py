"""Group-equivariant point convolution, aggregated in tiles that stay in cache."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import embedding_bag

from articulate_ssl.ops.dense_group_convolution import DenseGroupConvolution, is_faster_dense
from articulate_ssl.ops.neighborhood import Neighborhood
from articulate_ssl.ops.precision import fast_dtype

# Gathered features per tile, the largest buffer: on a CPU it stays in cache and in memory that malloc recycles (fresh
# pages cost more than the arithmetic); on a GPU each tile fills the machine.
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

    The [B, M, G, C, K] aggregate is never held whole: it is built tile by tile, and again in the backward pass. On a
    GPU, large ones are not built from gathered features (`dense_group_convolution.py`).
    Gradients reach `features` and `weight`; the geometry is constant. Under autocast the products run, and the result
    is, in the autocast type where the device multiplies it faster than float32.
    """
    device = weight.device
    dtype = fast_dtype(device) if torch.is_autocast_enabled(device.type) else weight.dtype
    with torch.autocast(device.type, enabled=False):
        weight, neighborhood = weight.to(dtype), neighborhood.to(dtype)
        if features is None:
            return _constant_input(neighborhood, weight, permutation)
        features, correlation = features.to(dtype), neighborhood.weight
        function = DenseGroupConvolution if is_faster_dense(features, correlation) else _GroupConvolution
        return function.apply(features, weight, neighborhood.index, correlation, permutation)


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
        grad_weight = torch.zeros_like(weight, dtype=torch.promote_types(weight.dtype, torch.float32))
        with torch.autocast(weight.device.type, enabled=False):
            for elements in tiling.element_blocks():
                kernel = tiling.kernel(elements)
                block = tiling.block(elements)
                grad_kernel = tiling.grad_kernel(elements)
                for samples in tiling.sample_blocks():
                    grad = grad_out[tiling.rows(samples), elements].transpose(0, 1)  # [s, b M, C']
                    aggregate = tiling.aggregate(block, samples).transpose(1, 2)
                    grad_kernel.baddbmm_(aggregate, grad, beta=min(1, samples.start))
                    grad_aggregate = tiling.grad_aggregate(grad, kernel)
                    grad_features[samples, :, elements] = tiling.scatter(grad_aggregate, samples)
                for slot, grad_element in zip(tiling.slot[elements], grad_kernel, strict=True):
                    grad_weight.index_add_(0, slot, grad_element.view_as(weight).to(grad_weight.dtype))
        return grad_features, grad_weight.to(weight.dtype), None, None, None


class _Tiling:
    """The aggregate of some group elements and samples at a time, in buffers that every tile uses again.

    Layout: aggregates and kernels have the flat axis (k', c), k' counting the unrotated kernel points. A tile of one
    group element is then an operand of a matrix product as it is, and so are its neighbours' features.
    """

    def __init__(
        self, features: Tensor, weight: Tensor, index: Tensor, correlation: Tensor, permutation: Tensor
    ) -> None:
        self.B, self.N, self.G, self.C = features.shape
        _, self.M, self.n, self.K = correlation.shape
        self.features, self.weight = features, weight
        self.correlation = correlation.flatten(0, 1)  # [B M, n, K]
        self.slot = permutation.argsort(dim=1)
        start = torch.arange(self.B, device=index.device) * self.N
        self.flat_index = (index + start[:, None, None]).flatten()
        # The tile: as many samples as fit, and if all do, as many group elements.
        budget = _TILE_ELEMENTS[features.device.type]
        per_sample = self.M * self.n * self.C
        self.b = min(self.B, max(1, budget // per_sample))
        self.s = min(self.G, max(1, budget // (per_sample * self.B)))
        # Even where one sample exceeds it, features are gathered for so few centres that they are still in cache.
        self.chunk = max(1, budget // (2 * self.n * self.s * self.C))
        self._gathered = features.new_empty(min(self.chunk, self.b * self.M) * self.n * self.s * self.C)
        self._aggregate = features.new_empty(self.b * self.M * self.s * self.C * self.K)
        self._kernel = weight.new_empty(self.s, *weight.shape)
        self._grad_kernel: Tensor | None = None
        self._bags: tuple[Tensor, Tensor] | None = None

    def element_blocks(self) -> Iterator[slice]:
        return (slice(g, min(g + self.s, self.G)) for g in range(0, self.G, self.s))

    def sample_blocks(self) -> Iterator[slice]:
        return (slice(b, min(b + self.b, self.B)) for b in range(0, self.B, self.b))

    def rows(self, samples: slice) -> slice:
        """The samples' rows among all B M outputs."""
        return slice(samples.start * self.M, samples.stop * self.M)

    def kernel(self, elements: slice) -> Tensor:
        """[s, K C, C'] weights of the group elements."""
        slot = self.slot[elements]
        out = self._kernel[: len(slot)]
        torch.index_select(self.weight, 0, slot.flatten(), out=out.flatten(0, 1))
        return out.flatten(1, 2)

    def grad_kernel(self, elements: slice) -> Tensor:
        """[s, K C, C'] room for the gradient of `kernel`."""
        if self._grad_kernel is None:
            self._grad_kernel = torch.empty_like(self._kernel)
        return self._grad_kernel[: elements.stop - elements.start].flatten(1, 2)

    def block(self, elements: slice) -> Tensor:
        """[B N, s C] features of the group elements."""
        return self.features[:, :, elements].reshape(self.B * self.N, -1)

    def aggregate(self, block: Tensor, samples: slice) -> Tensor:
        """[s, b M, K C] correlation-weighted sum of the neighbours' features."""
        first, last, width = self.rows(samples).start, self.rows(samples).stop, block.shape[1]
        aggregate = self._aggregate[: (last - first) * self.K * width].view(-1, self.K, width)
        for row in range(first, last, self.chunk):
            stop = min(row + self.chunk, last)
            gathered = self._gathered[: (stop - row) * self.n * width].view(-1, width)
            torch.index_select(block, 0, self.flat_index[row * self.n : stop * self.n], out=gathered)
            torch.bmm(
                self.correlation[row:stop].transpose(1, 2),
                gathered.view(stop - row, self.n, width),
                out=aggregate[row - first : stop - first],
            )
        return aggregate.unflatten(2, (-1, self.C)).permute(2, 0, 1, 3).flatten(2)

    def grad_aggregate(self, grad: Tensor, kernel: Tensor) -> Tensor:
        """[b M, K, s C] gradient of the aggregate from that of the output; takes the place of the aggregate."""
        s, count, _ = grad.shape
        out = self._aggregate[: s * count * self.K * self.C].view(s, count, self.K * self.C)
        torch.bmm(grad, kernel.transpose(1, 2), out=out)
        return out.unflatten(2, (self.K, self.C)).permute(1, 2, 0, 3).flatten(2)

    def scatter(self, grad_aggregate: Tensor, samples: slice) -> Tensor:
        """[b, N, s, C] gradient of the features: the transpose of `aggregate`, summed in a fixed order."""
        count, _, width = grad_aggregate.shape
        if self._bags is None:
            self._grad_gathered = self.features.new_empty(self.b * self.M * self.n * self.s * self.C)
            order = self.flat_index.sort(stable=True)
            bags = torch.arange(self.B * self.N, device=order.indices.device)
            self._bags = order.indices, torch.searchsorted(order.values, bags)
        grad_gathered = self._grad_gathered[: count * self.n * width].view(count, self.n, width)
        torch.bmm(self.correlation[self.rows(samples)], grad_aggregate, out=grad_gathered)
        order, start = self._bags
        first, last = samples.start * self.M * self.n, samples.stop * self.M * self.n
        summed = embedding_bag(
            order[first:last] - first,
            grad_gathered.flatten(0, 1),
            start[samples.start * self.N : samples.stop * self.N] - first,
            mode="sum",
        )
        return summed.view(samples.stop - samples.start, self.N, -1, self.C)
