"""Fused normalisation and activation against its twin under plain autograd."""

import pytest
import torch

from articulate_ssl.ops import normalization, reference


def _relative(a, b):
    return ((a - b).norm() / b.norm()).item()


def _problem(dtype=torch.float64, shape=(2, 5, 3, 7)):
    generator = torch.Generator().manual_seed(0)
    features, weight, bias = (
        torch.randn(size, dtype=dtype, generator=generator, requires_grad=True)
        for size in (shape, shape[-1:], shape[-1:])
    )
    return features, weight, bias


@pytest.mark.parametrize("block", [1, 7 * 4, 2**21])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_values_and_gradients_equal_the_reference(monkeypatch, block, dtype, tolerance):
    monkeypatch.setitem(normalization._BLOCK_ELEMENTS, "cpu", block)
    inputs = _problem(dtype)
    results = []
    for function in (normalization.layer_norm_leaky_relu, reference.layer_norm_leaky_relu):
        out = function(*inputs, 0.01)
        direction = torch.linspace(-1, 1, out.numel(), dtype=dtype).view_as(out)
        results.append((out, *torch.autograd.grad(out, inputs, direction)))
    for fast, slow in zip(*results, strict=True):
        assert _relative(fast, slow) < tolerance


def test_gradcheck():
    inputs = _problem(shape=(2, 3, 4))
    assert torch.autograd.gradcheck(lambda *x: normalization.layer_norm_leaky_relu(*x, 0.1), inputs)


def test_bfloat16_features_keep_their_type_and_normalise_in_full_precision():
    features, weight, bias = _problem(torch.float32)
    exact = reference.layer_norm_leaky_relu(features, weight, bias, 0.01)
    half = features.detach().bfloat16().requires_grad_()
    out = normalization.layer_norm_leaky_relu(half, weight, bias, 0.01)
    assert out.dtype == torch.bfloat16
    assert _relative(out.float(), exact) < 1e-2
    gradients = [
        torch.autograd.grad(o, (x, weight, bias), torch.linspace(-1, 1, o.numel()).view_as(o).to(o.dtype))
        for o, x in ((exact, features), (out, half))
    ]
    for a, b in zip(*gradients, strict=True):
        assert b.dtype == (torch.bfloat16 if b.dim() == 4 else torch.float32)
        assert _relative(b.float(), a) < 2e-2
