"""Places of extreme entries against PyTorch's own reductions."""

import pytest
import torch

from articulate_ssl.ops.extreme_index import index_of_largest, index_of_smallest, indices_of_smallest

DTYPES = [torch.float32, torch.float64]


def _values(shape, dtype):
    return torch.rand(shape, dtype=dtype, generator=torch.Generator().manual_seed(0)).square()


def _tolerance(length, dtype):
    """What is lost of an entry where its place is written: bits of 23 or 52."""
    return 2.0 ** ((length - 1).bit_length() - (23 if dtype == torch.float32 else 52))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("length", [1, 2, 70, 512, 1024, 1025, 5000])
def test_the_smallest_entry_is_found(length, dtype):
    values = _values((3, 40, length), dtype)
    index = index_of_smallest(values.clone())
    assert index.shape == (3, 40)
    found, smallest = values.gather(-1, index[..., None])[..., 0], values.amin(dim=-1)
    assert (found <= smallest * (1 + _tolerance(length, dtype))).all()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("dim", [0, 1, 2, -1, -2])
def test_the_largest_entry_is_found_along_any_axis(dim, dtype):
    values = _values((60, 70, 80), dtype) - 0.1
    index = index_of_largest(values.clone(), dim)
    found, largest = values.gather(dim, index.unsqueeze(dim)).squeeze(dim), values.amax(dim=dim)
    assert (found >= largest * (1 - _tolerance(80, dtype))).all()


def test_distinct_entries_are_told_apart():
    # Entries further apart than the bits that are lost: the very same places as PyTorch's.
    values = (1 + torch.rand(50, 64).argsort(dim=-1)).float()
    assert torch.equal(index_of_smallest(values.clone()), values.argmin(dim=-1))
    assert torch.equal(index_of_largest(values.clone(), 1), values.argmax(dim=-1))


def test_infinity_is_never_the_smallest_and_negative_rounding_always():
    values = torch.tensor([[torch.inf, 3.0, 2.0], [1.0, -1e-9, 0.5], [torch.inf, torch.inf, 1e30]])
    assert index_of_smallest(values.clone()).tolist() == [2, 1, 2]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("count", [1, 7, 99, 100])
def test_several_smallest_entries_are_those_of_topk(count, dtype):
    values = _values((4, 30, 100), dtype)
    before = values.clone()
    index = indices_of_smallest(values, count)
    assert torch.equal(values, before)
    expected = values.topk(count, dim=-1, largest=False).values
    assert torch.equal(values.gather(-1, index).sort(dim=-1).values, expected)
