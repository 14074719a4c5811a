"""Mean, median and a bootstrap interval that respects instances: clouds of one object are not independent."""

from __future__ import annotations

import torch
from torch import Tensor


def cluster_bootstrap(
    values: Tensor,  # [S]
    cluster: Tensor,  # [S] int64
    replicates: int,
    seed: int,
) -> tuple[float, float] | None:
    """95 % percentile interval of the mean when whole clusters are drawn with replacement.

    None with fewer than two clusters: one instance says nothing about the spread between instances.
    """
    _, index = cluster.unique(return_inverse=True)
    clusters = int(index.max()) + 1
    if clusters < 2:
        return None
    zeros = torch.zeros(clusters, dtype=torch.float64)
    total = zeros.scatter_add(0, index, values.double())
    count = zeros.scatter_add(0, index, torch.ones_like(values, dtype=torch.float64))
    draw = torch.randint(clusters, (replicates, clusters), generator=torch.Generator().manual_seed(seed))
    means = total[draw].sum(1) / count[draw].sum(1)
    low, high = means.quantile(torch.tensor([0.025, 0.975], dtype=torch.float64)).tolist()
    return low, high


def summarize(
    values: Tensor,  # [S], NaN where the quantity does not exist
    instance: Tensor,  # [S] int64
    replicates: int = 1000,
    seed: int = 0,
) -> dict[str, float | list[float] | None]:
    """`mean`, `median` (of the two middle values their mean) and `ci95` of the mean, over the values that exist."""
    exists = ~values.isnan()
    values, instance = values[exists].double().cpu(), instance[exists].cpu()
    if len(values) == 0:
        return {"mean": None, "median": None, "ci95": None}
    interval = cluster_bootstrap(values, instance, replicates, seed)
    return {
        "mean": float(values.mean()),
        "median": float(values.quantile(0.5)),
        "ci95": None if interval is None else list(interval),
    }
