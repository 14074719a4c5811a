"""Denormal numbers, flushed to zero where they only cost time."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def flush_denormals() -> Iterator[None]:
    """Flush denormal numbers to zero within the block or decorated function, and leave the processor as it was.

    Soft correspondences of far points are denormal, which makes a CPU's matrix products several times slower. The mode
    belongs to the calling thread and to threads that it starts, hence a program enters it once, before any work.
    """
    flushed = bool(torch.tensor(1e-40) * 1.0 == 0)
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(flushed)
