"""Which floating type a device multiplies fastest."""

from __future__ import annotations

import time
from functools import cache

import torch

_REQUIRED_GAIN = 1.3


def fast_dtype(device: torch.device) -> torch.dtype:
    """The type for matrix products under autocast: autocast's own, or float32 on a CPU that is no faster in it."""
    dtype = torch.get_autocast_dtype(device.type)
    if device.type != "cpu" or _cpu_gain(dtype) >= _REQUIRED_GAIN:
        return dtype
    return torch.float32


@cache
def _cpu_gain(dtype: torch.dtype) -> float:
    """Measured speed of matrix products relative to float32; instruction-set flags do not tell (5 ms, once)."""
    return _product_seconds(torch.float32) / _product_seconds(dtype)


def _product_seconds(dtype: torch.dtype, size: int = 384, repeats: int = 5) -> float:
    with torch.autocast("cpu", enabled=False), torch.no_grad():
        a = torch.ones(size, size, dtype=dtype)
        seconds = []
        for _ in range(repeats + 1):
            start = time.perf_counter()
            a @ a
            seconds.append(time.perf_counter() - start)
    return min(seconds)
