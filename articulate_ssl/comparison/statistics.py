"""One mean and one interval from the reports of several seeds.

All seeds are tested on the same objects, so more seeds make the chance of the objects no smaller: the half-interval
over instances is the mean of those of the seeds. The chance of the training is another: its half-interval is
Student's, of the means of the seeds, and shrinks with their number. The two are added as independent errors are, each
side for itself. With one seed, the interval is that over instances, and says nothing about other seeds. Of two or three
seeds Student's quantile is large, and where one training ends elsewhere than the others an interval may reach beyond
what is possible; it ends there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import fmean, stdev
from typing import Any, NamedTuple

from scipy.stats import t as student

_COVERED = 0.95


class Estimate(NamedTuple):
    """A mean over seeds and test clouds.

    Attributes:
        mean: Of the seeds' means.
        low: Of the 95 % interval over seeds and instances; None if some seed has no interval (one test object).
        high: The same.
        of_seeds: The mean of each.
    """

    mean: float
    low: float | None
    high: float | None
    of_seeds: tuple[float, ...]


def combined(statistics: Sequence[dict[str, Any]], largest: float = math.inf) -> Estimate | None:
    """From `mean` and `ci95` of each seed, the estimate; None if the quantity does not exist in some.

    Args:
        statistics: Of errors, distances or shares, which are not below zero.
        largest: That is possible.
    """
    if not statistics or any(one["mean"] is None for one in statistics):
        return None
    means = tuple(one["mean"] for one in statistics)
    mean = fmean(means)
    if any(one["ci95"] is None for one in statistics):
        return Estimate(mean, None, None, means)
    below = fmean(one["mean"] - one["ci95"][0] for one in statistics)
    above = fmean(one["ci95"][1] - one["mean"] for one in statistics)
    count = len(means)
    seeds = student.ppf((1 + _COVERED) / 2, count - 1) * stdev(means) / math.sqrt(count) if count > 1 else 0.0
    low, high = mean - math.hypot(below, seeds), mean + math.hypot(above, seeds)
    return Estimate(mean, max(low, 0.0), min(high, largest), means)
