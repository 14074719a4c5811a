"""The device that is measured."""

from __future__ import annotations

import ctypes
import gc
import platform
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import torch


class Machine:
    """Clock, memory meter and precision of one device."""

    def __init__(self, device: str, precision: str) -> None:
        self.device = torch.device(device)
        self.precision = precision

    @property
    def on_gpu(self) -> bool:
        """Whether calls return before their work is done, and memory is CUDA's."""
        return self.device.type == "cuda"

    @property
    def name(self) -> str:
        """The device in words."""
        if self.on_gpu:
            return torch.cuda.get_device_name(self.device)
        model = platform.processor() or platform.machine()
        cpuinfo = Path("/proc/cpuinfo")
        if cpuinfo.exists():
            names = [line.split(":")[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
            model = names[0] if names else model
        return f"{model}, {torch.get_num_threads()} threads"

    def autocast(self):
        """Mixed precision where it was asked for."""
        return torch.autocast(self.device.type, torch.bfloat16) if self.precision == "bf16" else nullcontext()

    def seconds(self, function: Callable[[], object]) -> float:
        """Wall-clock seconds of one call."""
        start = self.time()
        function()
        return self.time() - start

    def time(self) -> float:
        """The clock, once the device has done all that it was given."""
        if self.on_gpu:
            torch.cuda.synchronize()
        return time.perf_counter()

    def peak_bytes(self, function: Callable[[], object]) -> float:
        """Largest memory during one call, beyond what was held before it (Linux or CUDA)."""
        before = self.forget_peak()
        function()
        return self.peak() - before

    def forget_peak(self) -> float:
        """Bytes that are held now; `peak` is the largest number from here on."""
        gc.collect()
        if self.on_gpu:
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats()
            return torch.cuda.memory_allocated()
        ctypes.CDLL(None).malloc_trim(0)  # memory that malloc keeps for later would hide what the call needs
        Path("/proc/self/clear_refs").write_text("5")  # resets the high-water mark
        return _status_bytes("VmRSS")

    def peak(self) -> float:
        """Bytes."""
        return torch.cuda.max_memory_allocated() if self.on_gpu else _status_bytes("VmHWM")


def _status_bytes(field: str) -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(1024 * float(line.split()[1]) for line in lines if line.startswith(field + ":"))
