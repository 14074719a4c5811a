"""Where the smallest or largest entries of a row are: on a CPU, several times faster than PyTorch's reductions say it.

A CPU finds the extreme *value* of a row quickly but not its place, which does not vectorise. So the place is written
into the value: a floating number that is not negative orders like the integer that its bits spell, and the lowest of
these bits can spell the place instead. That rounds the value by less than 2^(b - 23) of itself in single precision, for
rows of 2^b entries.
"""

from __future__ import annotations

import torch
from torch import Tensor

_INTEGER = {torch.float32: torch.int32, torch.float64: torch.int64}
_SPARE_BITS = {torch.float32: 10, torch.float64: 32}  # of the fraction


def index_of_smallest(
    values: Tensor,  # [..., M]; overwritten
) -> Tensor:  # [...] int64
    """Place of the smallest entry of every row; of entries equal to about 1e-4 of their size, any.

    Negative entries count as zeros, of which any is smallest, and NaN as larger than everything.
    """
    bits = (values.shape[-1] - 1).bit_length()
    if not _has_room(values, bits):
        return values.min(dim=-1).indices
    return (_write_places(values, bits, -1).amin(dim=-1) & (1 << bits) - 1).long()


def index_of_largest(
    values: Tensor,  # overwritten
    dim: int,
) -> Tensor:  # int64, without `dim`
    """Place of the largest entry along `dim` where that is positive, else any; of entries equal to about 1e-4, any."""
    bits = (values.shape[dim] - 1).bit_length()
    if not _has_room(values, bits):
        return values.max(dim=dim).indices
    return (_write_places(values, bits, dim).amax(dim=dim) & (1 << bits) - 1).long()


def indices_of_smallest(
    values: Tensor,  # [..., M]
    count: int,
) -> Tensor:  # [..., count] int64
    """Places of the `count` smallest entries of every row, in no particular order; exact in single precision."""
    if values.device.type != "cpu" or count == values.shape[-1]:
        return values.topk(count, dim=-1, largest=False, sorted=False).indices
    bits = (values.shape[-1] - 1).bit_length()
    packed = _write_places(values.to(torch.float64, copy=True), bits, -1)
    packed.numpy().partition(count - 1, axis=-1)  # vectorised where the processor allows; PyTorch's selection is not
    return packed[..., :count] & (1 << bits) - 1


def _has_room(values: Tensor, bits: int) -> bool:
    """Whether the values can spell the place and remain themselves; never on devices that need no such help."""
    return values.device.type == "cpu" and bits <= _SPARE_BITS.get(values.dtype, -1)


def _write_places(values: Tensor, bits: int, dim: int) -> Tensor:
    """The values' bits as integers, the lowest replaced by the place along `dim`; in place."""
    packed = values.view(_INTEGER[values.dtype])
    packed &= -1 << bits
    packed.movedim(dim, -1).bitwise_or_(torch.arange(values.shape[dim], dtype=packed.dtype))
    return packed
