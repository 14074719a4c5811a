"""The paper's recipe: its objective from the first step on; no discovery, no registration.

The objective alone has a stable optimum in which one part is everything and no joint moves (findings, section 4). What
keeps the parts alive, each but the first with an option:

1. Parts start apart, as flaps about a joint (`CategoryObject.start_apart`), not as one cloud of points.
2. Hypotheses start from several joint states beside the rotations (`network.state_anchors`), and for the first
   `schedule.balanced_share` of the steps the clouds of a batch are spread evenly over them. Left alone, shapes adapt to
   the one state that explains most, and within two hundred steps no other is ever chosen. That objects are spread
   evenly over their range of articulation is how the paper makes its sets.
3. For the first `schedule.equal_parts_share` of the steps parts are drawn, less and less, to equal shares of a cloud
   (Sinkhorn's rounds of the posterior association). Without it the states of laptops stayed unrelated to the true ones.
4. For the first `schedule.shared_share` of the steps all instances have one shape: with their own they explain
   articulation by shape. Then they are freed.
5. Posed parts teach the slots, which after `schedule.agreement_share` of the steps have a say in which hypothesis is
   chosen (`objective.association`, `.agreement`). With a say from the first step on they held on to a split that was
   not one (seen once, with other changes beside it).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from articulate_ssl.inference.candidates import Iteration
from articulate_ssl.losses.balanced_assignment import balanced_assignment
from articulate_ssl.losses.objective import paper_terms
from articulate_ssl.ops.ranks import of_all_ranks, own_rows
from articulate_ssl.training.recipes.recipe import Outcome, Recipe

STATE_COMBINATIONS = 4  # of joint states that hypotheses start from, at most, where the options leave it open
_COMPARED = 128  # points, to choose among up to 240 hypotheses a cloud: all of them take longer than all else
# Of the category's shapes and joints relative to the networks': they start as flaps and have tenths of the object's
# size to go. Chosen, and the first try worked.
_CATEGORY_RATE = 2.5


class TrainingRecipe(Recipe):
    """Of every cloud the hypothesis that reconstructs it best trains; the learning rate decays in steps."""

    # Either plate of a laptop has points beyond the hinge, where the nearest one decides nothing: mIoU .81 and .79 by
    # the nearest point, .89 and .91 by three, .89 and .91 by six (two trainings; docs/experiments.md, step 65).
    refines, part_neighbours = False, 6

    def __init__(self, *args) -> None:
        super().__init__(*args)
        self.estimator.agreement, self.estimator.compared = self.objective.agreement, _COMPARED
        self.estimator.articulated.category.start_apart()

    @staticmethod
    def state_anchors(num_parts: int) -> int:
        """As many as make at most `STATE_COMBINATIONS`."""
        return max(n for n in range(1, STATE_COMBINATIONS + 1) if n == 1 or n ** (num_parts - 1) <= STATE_COMBINATIONS)

    def step(self, points: Tensor, step: int, generator: Callable[[], torch.Generator]) -> Outcome:
        """L_rec + lambda L_reg of the winners of all iterations."""
        progress = self._progress(step)
        self.estimator.articulated.shape_head.freedom = self._freedom(progress)
        agrees = progress >= self.schedule.agreement_share
        self.estimator.agreement = self.objective.agreement if agrees else 0.0
        equal = self.schedule.equal_parts_share
        balance = max(0.0, 1 - progress / equal) if equal else 0.0
        aligned, _ = self.estimator.align(points)
        trained = []
        for iteration in self.estimator.iterate(aligned):
            first = iteration.start is None
            balanced = first and progress < self.schedule.balanced_share
            selected = iteration.hypotheses.select(self._spread(iteration) if balanced else iteration.winner)
            trained.append((paper_terms(selected, aligned, self.objective, balance), selected))
        return Outcome.of(trained)

    def network_rate(self, step: int) -> float:
        """Multiplied by `decay` every `decay_every` steps of the articulated network; stage 0 keeps the initial one.

        With that decay 4,000 steps of stage 0 end at a larger loss (ovens, one seed; docs/experiments.md, step 201).
        """
        return self.schedule.decay ** (max(0, step - self.schedule.rigid_steps) // self.schedule.decay_every)

    def category_rate(self, step: int) -> float:
        """Faster than the networks."""
        return _CATEGORY_RATE * self.network_rate(step)

    def _progress(self, step: int) -> float:
        """From 0 to 1 over the steps of the articulated network."""
        stage0 = self.schedule.rigid_steps
        return (step - stage0) / max(1, self.schedule.steps - stage0)

    def _freedom(self, progress: float) -> float:
        """Share of their own shape that instances have: from 0 to 1 in half of the steps that are left."""
        shared = self.schedule.shared_share
        return 1.0 if shared == 0 else min(max(progress - shared, 0.0) / max(0.5 * (1 - shared), 1e-6), 1.0)

    def _spread(self, iteration: Iteration) -> Tensor:
        """Of every cloud a hypothesis [B], each start of the joint states for equally many clouds of all ranks."""
        starts = len(self.estimator.articulated.pose_head.anchors)
        least, element = iteration.ranked.unflatten(1, (-1, starts)).min(dim=1)  # [B, A], over the group
        start = own_rows(balanced_assignment(of_all_ranks(least)))
        return element.gather(1, start[:, None])[:, 0] * starts + start
