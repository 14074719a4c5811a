"""Batches that several processes share: what a step needs of all clouds, it must compute as one process would.

Each of R processes, a *rank*, holds B clouds of a step: of the R B clouds that one process would hold, rank r has every
R-th from the r-th on (`datamodules.samplers.TrainingStream`). Gradients of a loss that is a mean over clouds need
nothing more than DDP's average. What spreads, counts or draws over the batch goes through here. One process gets back
what it gave.
"""

from __future__ import annotations

import torch
from torch import Tensor, distributed


def world() -> tuple[int, int]:
    """R and r."""
    if not (distributed.is_available() and distributed.is_initialized()):
        return 1, 0
    return distributed.get_world_size(), distributed.get_rank()


@torch.no_grad()
def of_all_ranks(
    rows: Tensor,  # [B, ...] of this rank's clouds; B is the same on every rank
) -> Tensor:  # [R B, ...]
    """The rows of all ranks' clouds, in one process's order; no gradient. Every rank has to call it."""
    ranks, _ = world()
    if ranks == 1:
        return rows.detach()
    gathered = [torch.empty_like(rows, memory_format=torch.contiguous_format) for _ in range(ranks)]
    distributed.all_gather(gathered, rows.detach().contiguous())
    return torch.stack(gathered, dim=1).flatten(0, 1)


def own_rows(
    rows: Tensor,  # [R B, ...] of all clouds
) -> Tensor:  # [B, ...]
    """Those of this rank's clouds."""
    ranks, rank = world()
    return rows[rank::ranks]
