"""What every method of the comparison is: trained, if it learns at all, and tested by the same code on the same clouds.

A method is a `LightningModule`, one file each. It says what it is given beyond the clouds, learns in `training_step`
and answers with a `Prediction`, which the same metrics score that score the network.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import torch
from lightning.pytorch import LightningModule
from torch import Tensor

from articulate_ssl.inference.prediction import Prediction
from datamodules.articulated_data_module import ArticulatedDataModule

PART_LABELS = "part labels"
PART_POSES = "part poses"
JOINTS = "joints"
OCCUPANCY = "occupancy"
TEST_PARTS = "parts at test"
DENSE_CLOUDS = "dense clouds"  # at test, all stored points of a cloud (`dense_points`), not only the scored ones

SEGMENTATION = "segmentation"
POSES = "poses"
JOINT_LINES = "joints"
RECONSTRUCTION = "reconstruction"  # alone, without poses of parts, of which it is a consequence


@dataclass(frozen=True)
class Problem:
    """What any method may know of a category: what the network is told, too.

    Attributes:
        num_parts: K.
        joint_type: `REVOLUTE` or `PRISMATIC`, of all joints.
        state_range: Width of the articulation range, radians or normalised length.
        num_points: Of an input cloud.
        orientation_range: How far objects are turned from their mean orientation at most, in degrees; 180 for any.
    """

    num_parts: int
    joint_type: int
    state_range: float
    num_points: int
    orientation_range: float = 180.0


@dataclass(frozen=True)
class Effort:
    """How long a method trains.

    Attributes:
        steps: Of the optimiser; 0 for what does not learn.
        batch_size: Clouds a step.
        learning_rate: At the start of half a cosine that ends at a fiftieth.
    """

    steps: int
    batch_size: int
    learning_rate: float


class Method(LightningModule):
    """One row of the table.

    A subclass is named in `METHODS` (`baselines/__init__.py`), sets the class attributes, and implements `prepare` if
    anything comes before training, `training_step` if it learns, and `predict`.

    Attributes:
        title: Name of the row, as the paper has it.
        given: What training (or the test: `TEST_PARTS`) reads beyond clouds.
        says: What of a prediction is the method's own; the rest is filled in and no column shows it.
        effort: On two CPU cores. `Effort(0, …)` does not train.
        labelled_spaces: Whether slots and canonical part spaces are the labelled ones (those of `perfect_oracle`), so
            that metrics are calibrated on the labels and not on the method's predictions of training clouds.
        views: Of which views it is defined.
    """

    title: ClassVar[str]
    given: ClassVar[tuple[str, ...]] = ()
    says: ClassVar[tuple[str, ...]] = (SEGMENTATION, POSES, JOINT_LINES)
    effort: ClassVar[Effort]
    labelled_spaces: ClassVar[bool] = False
    views: ClassVar[tuple[str, ...]] = ("complete", "partial")

    def __init__(self, problem: Problem) -> None:
        super().__init__()
        self.problem = problem
        self.save_hyperparameters({"problem": asdict(problem)}, logger=False)

    def prepare(self, data: ArticulatedDataModule, seed: int) -> None:
        """What comes before the first step, e.g. templates of training clouds: kept in buffers, so in checkpoints."""
        return

    @abstractmethod
    def predict(self, batch: dict[str, Tensor]) -> Prediction:
        """Of B test clouds, of which it reads `points` [B, N, 3] and what `given` names for the test."""

    def parameter_groups(self) -> list[dict[str, Any]]:
        """What the optimiser moves; a group may have a first learning rate `lr` of its own."""
        return [{"params": list(self.parameters())}]

    def configure_optimizers(self) -> dict[str, Any]:
        """Adam, its rate along half a cosine."""
        optimizer = torch.optim.Adam(self.parameter_groups(), lr=self.effort.learning_rate)
        steps = max(1, self.effort.steps)
        scheduler = torch.optim.lr_scheduler.LambdaLR(
            optimizer, lambda step: 0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * min(step / steps, 1)))
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}


def no_joints(
    points: Tensor,  # [B, N, 3]
) -> dict[str, Tensor]:
    """Every joint field of a prediction that says nothing of joints, J = 0."""
    none = points.new_zeros(len(points), 0)
    index = torch.zeros(len(points), 0, dtype=torch.long, device=points.device)
    vector = points.new_zeros(len(points), 0, 3)
    return {
        "joint_parent": index,
        "joint_child": index,
        "joint_type": index,
        "joint_axis": vector,
        "joint_pivot": vector,
        "joint_state": none,
        "canonical_axis": vector,
        "canonical_pivot": vector,
    }
