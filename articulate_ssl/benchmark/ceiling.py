"""The rate of plain matrix products, which no backbone made of them can exceed."""

from __future__ import annotations

import torch

from articulate_ssl.benchmark.machine import Machine
from articulate_ssl.benchmark.result import Result


def ceiling(machine: Machine, backbone_seconds: float) -> list[Result]:
    """How close the backbone's forward + backward comes to the machine's measured rate of matrix products."""
    size = 8192 if machine.on_gpu else 2048
    dtype = torch.bfloat16 if machine.precision == "bf16" else torch.float32
    a = torch.randn(size, size, device=machine.device, dtype=dtype)
    machine.seconds(lambda: a @ a)
    rate = 2 * size**3 / min(machine.seconds(lambda: a @ a) for _ in range(5))
    positions, kernel_points, neighbors = 512 * 60, 24, 64
    products = sum(
        positions * kernel_points * c_in * (neighbors * (c_in > 1) + c_out)
        for c_in, c_out in ((1, 64), (64, 128), (128, 512))
    )
    floor = 3 * 2 * products / rate  # forward, and twice as much backward
    return [
        Result(None, f"matrix products {size}^3 ({dtype})", [rate / 1e12], "TFLOP/s"),
        Result(None, "backbone, share of that rate", [floor / backbone_seconds]),
    ]
