"""The paper's recipe: its objective from the first step on, and nothing else."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from articulate_ssl.losses.objective import paper_terms
from articulate_ssl.training.recipes.recipe import Outcome, Recipe


class TrainingRecipe(Recipe):
    """Of every cloud the hypothesis that reconstructs it best trains; the learning rate decays in steps."""

    def step(self, points: Tensor, step: int, generator: Callable[[], torch.Generator]) -> Outcome:
        """L_rec + lambda L_reg of the winners of all iterations."""
        aligned, _ = self.estimator.align(points)
        trained = []
        for iteration in self.estimator.iterate(aligned):
            selected = iteration.hypotheses.select(iteration.winner)
            trained.append((paper_terms(selected, aligned, self.objective), selected))
        return Outcome.of(trained)

    def network_rate(self, step: int) -> float:
        """Multiplied by `decay` every `decay_every` steps."""
        return self.schedule.decay ** (step // self.schedule.decay_every)
