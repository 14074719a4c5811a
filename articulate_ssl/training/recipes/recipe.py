"""What a recipe is: the loss of a step, how fast what learns, and what it finds out before the networks learn."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.inference.pose_estimation import PoseEstimator
from articulate_ssl.losses.objective import ObjectiveOptions, Terms
from articulate_ssl.network.hypotheses import Hypotheses
from articulate_ssl.training.schedule import ScheduleOptions


class Outcome(NamedTuple):
    """Of one step.

    Attributes:
        loss: What is differentiated: the mean over the iterations of pose estimation.
        terms: Of the last iteration.
        selected: The hypothesis of each cloud that trained, in the last iteration.
    """

    loss: Tensor
    terms: Terms
    selected: Hypotheses

    @staticmethod
    def of(iterations: list[tuple[Terms, Hypotheses]]) -> Outcome:
        """From the terms and selected hypotheses of every iteration."""
        return Outcome(torch.stack([terms.loss for terms, _ in iterations]).mean(), *iterations[-1])


class TrainingClouds(Protocol):
    """The clouds of a training set, as recipes ask for them before the first step; without labels."""

    def clouds(self, count: int) -> Tensor:
        """So many of them [n, N, 3], with all their points."""

    def scans(self, count: int) -> tuple[Tensor, Tensor]:
        """So many complete clouds [n, N, 3]: the same, or where these are depth views, scans of their category.

        And which object each shows [n], as `objects` names them.
        """

    def objects(self, count: int) -> tuple[Tensor, Tensor]:
        """About as many scans of whole objects [n, N, 3], and which object each shows [n]."""


class Recipe(ABC):
    """Trains the articulated network; stage 0, if there is one, comes before and is the same for all recipes.

    Args:
        estimator: Whose networks are trained.
        objective: Weights of the losses.
        schedule: Steps and learning rates.
        discovery: Effort of part discovery.
    """

    def __init__(
        self,
        estimator: PoseEstimator,
        objective: ObjectiveOptions,
        schedule: ScheduleOptions,
        discovery: DiscoveryOptions,
    ) -> None:
        self.estimator, self.objective = estimator, objective
        self.schedule, self.discovery = schedule, discovery

    # At test time, where the options leave it to the recipe: by registration, and `InferenceOptions.part_neighbours`.
    refines, part_neighbours = True, 1
    learns_tree = True  # or it was found before, and stays
    cheap_steps = 0  # so many at the start are of another kind, which takes less time than the steps to come

    @staticmethod
    def state_anchors(num_parts: int) -> int:
        """`NetworkOptions.state_anchors` where the options leave it to the recipe."""
        return 0

    @property
    def multi_state(self) -> bool:
        """Whether the recipe uses which clouds show the same object, which results have to say."""
        return False

    @property
    def ready(self) -> bool:
        """Whether the networks have begun to learn, so that it makes sense to validate them."""
        return True

    def prepare(self, data: TrainingClouds, num_points: int) -> None:
        """What comes before the first step after stage 0, unless the recipe is ready. Done by one rank, for all.

        Others take over what it found: the module's state, and what `kept` says.

        Args:
            data: What there is to learn from.
            num_points: Of a cloud in training.
        """
        return

    @abstractmethod
    def step(
        self,
        points: Tensor,  # [B, N, 3]
        step: int,
        generator: Callable[[], torch.Generator],
    ) -> Outcome:
        """The loss of a batch of training clouds.

        Args:
            generator: Makes one for what is random in this step, the same on every rank: each draws for the clouds of
                all, and takes its own (`ops.ranks`).
        """

    @abstractmethod
    def network_rate(self, step: int) -> float:
        """Learning rate of the networks relative to the initial one."""

    def category_rate(self, step: int) -> float:
        """The same for category-level shapes and joints."""
        return self.network_rate(step)

    def kept(self) -> dict[str, Tensor | None] | None:
        """What a checkpoint must keep for training to resume."""
        return None

    def restore(self, kept: dict[str, Tensor | None] | None) -> None:
        """Take it back."""
        return
