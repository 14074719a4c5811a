"""The memory meter sees what a call needs."""

import pytest
import torch

from articulate_ssl.benchmark.machine import Machine


def test_peak_memory_sees_a_temporary():
    size = 2**26
    peak = Machine("cpu", "32").peak_bytes(lambda: torch.ones(size // 4).sum())
    assert peak == pytest.approx(size, rel=0.2)
