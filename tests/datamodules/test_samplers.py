"""The endless training stream and the lossless evaluation split."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from datamodules.samplers import EvaluationSampler, TrainingStream


def take(count: int, start: int = 0, world: int = 1, rank: int = 0, seed: int = 0, batch_size: int = 4) -> list:
    """The first `count` keys of consecutive epochs of a stream over 10 samples."""
    consumed = [start]

    def epochs():
        stream = TrainingStream(range(10), batch_size, lambda: consumed[0], seed, world, rank)
        while True:
            yield from stream
            consumed[0] += len(stream) * world

    return list(itertools.islice(epochs(), count))


def test_every_pass_visits_every_sample_once_in_another_order():
    keys = take(30)
    passes = [[index for index, _ in keys[10 * p : 10 * p + 10]] for p in range(3)]
    assert all(sorted(p) == list(range(10)) for p in passes)
    assert passes[0] != passes[1] != passes[2]
    assert [position for _, position in keys] == list(range(30))


def test_any_position_can_be_the_start():
    full = take(60)
    for start in (0, 1, 7, 10, 25):
        assert take(30, start) == full[start : start + 30]


def test_seed_changes_the_order():
    assert take(10) != take(10, seed=1)


@pytest.mark.parametrize("world", [2, 3])
def test_ranks_deal_out_the_one_stream(world):
    per_rank = [take(12, world=world, rank=rank) for rank in range(world)]
    dealt = list(itertools.chain.from_iterable(zip(*per_rank, strict=True)))
    assert dealt == take(12 * world)


@pytest.mark.parametrize(("batch_size", "world", "length"), [(4, 1, 12), (5, 1, 10), (4, 2, 8), (16, 1, 16)])
def test_an_epoch_is_whole_batches_of_at_least_one_pass(batch_size, world, length):
    stream = TrainingStream(range(10), batch_size, lambda: 0, num_replicas=world)
    assert len(stream) == len(list(stream)) == length


@pytest.mark.parametrize("world", [1, 2, 3, 8])
def test_evaluation_visits_every_index_exactly_once_over_all_ranks(world):
    indices = np.array([2, 3, 5, 7, 11])
    samplers = [EvaluationSampler(indices, world, rank) for rank in range(world)]
    assert sorted(itertools.chain.from_iterable(samplers)) == indices.tolist()
    assert all(len(sampler) == len(list(sampler)) for sampler in samplers)
