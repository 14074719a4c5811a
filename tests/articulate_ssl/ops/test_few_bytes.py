"""Clouds in a byte a coordinate come back to half a step."""

import torch

from articulate_ssl.ops.few_bytes import from_few_bytes, in_few_bytes


def test_clouds_come_back():
    clouds = (
        torch.randn(4, 50, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([0.01, 1, 3, 0])[:, None, None]
    )
    rounded, step = in_few_bytes(clouds)
    assert rounded.dtype == torch.int8 and step.shape == (4,)
    apart = (from_few_bytes(rounded, step) - clouds).abs().amax(dim=(1, 2))
    assert (apart <= 0.501 * step).all() and apart[1] > 0
