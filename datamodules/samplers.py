"""Which sample comes when: an endless resumable training stream and a lossless split of test samples over ranks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sized

import numpy as np
from torch.utils.data import DistributedSampler


class TrainingStream(DistributedSampler):
    """An endless stream of shuffled passes over the data, cut into epochs, that any position can be the start of.

    Position t of the stream is sample `t mod S` of the shuffled pass `t div S`; the order of a pass depends on `seed`
    and its number alone. Rank r of R takes every R-th position from the r-th on. An epoch is the smallest number of
    whole batches with at least S samples; the next one continues where it stopped, so no sample is ever dropped.

    Yields:
        Pairs (sample index, position).

    Args:
        dataset: Anything with a length S.
        batch_size: Per rank.
        consumed: Says how many positions, over all ranks, training has used up when an epoch starts.
        seed: Of the shuffling.
        num_replicas: R.
        rank: r.
    """

    # A DistributedSampler by type, so that Lightning leaves it in place.

    def __init__(
        self,
        dataset: Sized,
        batch_size: int,
        consumed: Callable[[], int],
        seed: int = 0,
        num_replicas: int = 1,
        rank: int = 0,
    ) -> None:
        super().__init__(dataset, num_replicas=num_replicas, rank=rank, seed=seed)
        self.consumed = consumed
        self.num_samples = batch_size * -(-len(dataset) // (batch_size * num_replicas))

    def __iter__(self) -> Iterator[tuple[int, int]]:
        size = len(self.dataset)
        first = self.consumed() + self.rank
        order, current_pass = np.empty(0, np.int64), -1
        for position in range(first, first + self.num_samples * self.num_replicas, self.num_replicas):
            if position // size != current_pass:
                current_pass = position // size
                order = np.random.default_rng([self.seed, current_pass]).permutation(size)
            yield int(order[position % size]), position


class EvaluationSampler(DistributedSampler):
    """The given sample indices in order, every one on exactly one rank: unlike its base class it repeats none.

    Args:
        indices: Sample indices to visit.
        num_replicas: R.
        rank: Takes every R-th index from the `rank`-th on.
    """

    def __init__(self, indices: np.ndarray, num_replicas: int = 1, rank: int = 0) -> None:
        super().__init__(indices, num_replicas=num_replicas, rank=rank, shuffle=False)
        self.indices = [int(i) for i in indices[rank::num_replicas]]
        self.num_samples = len(self.indices)

    def __iter__(self) -> Iterator[int]:
        return iter(self.indices)
