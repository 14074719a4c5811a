"""Layer normalisation and LeakyReLU in one pass over the features, block by block."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import leaky_relu_

_BLOCK_ELEMENTS = {"cpu": 2**21, "cuda": 2**40}


def layer_norm_leaky_relu(
    features: Tensor,  # [..., C]
    weight: Tensor,  # [C]
    bias: Tensor,  # [C]
    slope: float,
    eps: float = 1e-5,
) -> Tensor:  # [..., C]
    """LeakyReLU(LayerNorm(features)) over the last axis, in the type of the features.

    Neither the normalised features nor their gradient is ever held whole. The slope must be positive: the backward
    pass reads the sign of the normalised features off the result.
    """
    return _NormActivation.apply(features, weight, bias, slope, eps)


class _NormActivation(torch.autograd.Function):
    @staticmethod
    def forward(ctx, features, weight, bias, slope, eps):
        def normalise(block: Tensor) -> tuple[Tensor, ...]:
            normalised, *statistics = torch.native_layer_norm(block.to(weight.dtype), weight.shape, weight, bias, eps)
            return leaky_relu_(normalised, slope).to(features.dtype), *statistics

        out, *statistics = _blockwise(normalise, features.shape[-1], features)
        ctx.save_for_backward(features, out, *statistics, weight, bias)
        ctx.slope = slope
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_out):
        features, out, mean, scale, weight, bias = ctx.saved_tensors
        grad_weight, grad_bias = torch.zeros_like(weight), torch.zeros_like(bias)

        def differentiate(block: Tensor, result: Tensor, grad: Tensor, *statistics: Tensor) -> tuple[Tensor]:
            grad = torch.ops.aten.leaky_relu_backward(grad, result, ctx.slope, True).to(weight.dtype)
            grad_block, *grads = torch.ops.aten.native_layer_norm_backward(
                grad, block.to(weight.dtype), weight.shape, *statistics, weight, bias, [True, True, True]
            )
            grad_weight.add_(grads[0])
            grad_bias.add_(grads[1])
            return (grad_block.to(features.dtype),)

        (grad_features,) = _blockwise(differentiate, features.shape[-1], features, out, grad_out, mean, scale)
        return grad_features, grad_weight, grad_bias, None, None


def _blockwise(function: Callable[..., tuple[Tensor, ...]], channels: int, *inputs: Tensor) -> list[Tensor]:
    """Apply a function of corresponding rows, which are the last axis of every tensor, to one block after another."""
    shape = inputs[0].shape[:-1]
    rows = [t.reshape(-1, t.shape[-1]) for t in inputs]
    size = max(1, _BLOCK_ELEMENTS[inputs[0].device.type] // channels)
    blocks = zip(*(t.split(size) for t in rows), strict=True)
    if len(rows[0]) <= size:
        whole = function(*next(blocks))
    else:
        whole = None
        for number, block in enumerate(blocks):
            parts = function(*block)
            if whole is None:
                whole = [p.new_empty(len(rows[0]), p.shape[-1]) for p in parts]
            for target, part in zip(whole, parts, strict=True):
                target[number * size :][: len(part)] = part
    return [t.view(*shape, -1) for t in whole]
