"""Methods whose scores are known beforehand, and one that is quick to train."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn
from torch.nn.functional import cross_entropy, one_hot

from articulate_ssl.baselines.method import JOINT_LINES, JOINTS, PART_LABELS, SEGMENTATION, Effort, Method, Problem
from articulate_ssl.baselines.perfect_oracle import perfect_oracle
from articulate_ssl.inference.prediction import Prediction, concatenate
from datamodules.articulated_data_module import ArticulatedDataModule

QUANTILES = 12


def problem(num_points: int, joint_type: int = 0) -> Problem:
    """Of the synthetic sets."""
    return Problem(num_parts=2, joint_type=joint_type, state_range=1.3, num_points=num_points)


def constant(points: Tensor, joint_type: int = 0) -> Prediction:
    """The same for every cloud [B, N, 3] of two parts: nothing is turned, all points are of part 0."""
    clouds, count = points.shape[:2]
    eye = torch.eye(4).expand(clouds, 4, 4)
    axis = torch.tensor([0.0, 0.0, 1.0]).expand(clouds, 1, 3)
    none = torch.zeros(clouds, 1, dtype=torch.long)
    part_id = torch.zeros(clouds, count, dtype=torch.long)
    return Prediction(
        part_id=part_id,
        part_probability=one_hot(part_id, 2).float(),
        part_pose=eye[:, None].repeat(1, 2, 1, 1),
        part_shape=torch.zeros(clouds, 2, 4, 3),
        assembly=torch.zeros(clouds, 2, 3),
        base_pose=eye.clone(),
        joint_parent=none,
        joint_child=none + 1,
        joint_type=none + joint_type,
        joint_axis=axis,
        joint_pivot=torch.zeros(clouds, 1, 3),
        joint_state=torch.zeros(clouds, 1),
        canonical_axis=axis,
        canonical_pivot=torch.zeros(clouds, 1, 3),
        reconstruction_error=torch.zeros(clouds),
        margin=torch.ones(clouds),
    )


class Constant(Method):
    """Says the same of every cloud."""

    title, effort = "constant", Effort(0, 16, 0.0)

    def predict(self, batch: dict[str, Tensor]) -> Prediction:
        return constant(batch["points"], self.problem.joint_type)


class LookUp(Method):
    """Knows every cloud that it will see, by heart."""

    title, effort = "look-up", Effort(0, 16, 0.0)

    def prepare(self, data: ArticulatedDataModule, seed: int) -> None:
        data.setup("test")
        batches = [*data.test_dataloader(), *data.calibration_dataloader()]
        self.truth = concatenate([perfect_oracle(batch) for batch in batches])
        self.first = torch.cat([batch["points"][:, 0] for batch in batches])

    def predict(self, batch: dict[str, Tensor]) -> Prediction:
        assert set(batch) == {"points"}
        row = (self.first[None] - batch["points"][:, :1]).abs().sum(-1).argmin(1)
        return self.truth[row]


class Killed(RuntimeError):
    """Stands in for a kill."""


class Shells(Method):
    """Parts by how far a point is from the others: learns from labels, and draws random numbers while it does."""

    title, effort = "shells", Effort(12, 4, 0.02)
    given, says, labelled_spaces = (PART_LABELS,), (SEGMENTATION,), True
    dies_at = None

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem)
        self.layers = nn.Sequential(nn.Linear(QUANTILES, 32), nn.ReLU(), nn.Linear(32, 2))
        self.register_buffer("mean", torch.zeros(0))
        self.prepared = 0

    def prepare(self, data: ArticulatedDataModule, seed: int) -> None:
        self.prepared += 1
        (batch, *_) = data.calibration_dataloader(16)
        self.mean = self._read(batch["points"]).mean((0, 1))

    def _read(self, points: Tensor) -> Tensor:
        return torch.cdist(points, points).quantile(torch.linspace(0.05, 1, QUANTILES), dim=-1).permute(1, 2, 0)

    def _logits(self, points: Tensor) -> Tensor:
        return self.layers(self._read(points) - self.mean)

    def training_step(self, batch: dict[str, Tensor], _index: int) -> Tensor:
        assert not {*batch} & {"part_pose", "joint_axis", "occupancy"}
        if self.global_step == self.dies_at:
            raise Killed
        points = batch["points"] + 0.01 * torch.randn_like(batch["points"])
        target = batch["dense_part_id"][:, : points.shape[1]].long()
        return cross_entropy(self._logits(points).flatten(0, 1), target.flatten())

    def predict(self, batch: dict[str, Tensor]) -> Prediction:
        return replace(constant(batch["points"]), part_id=self._logits(batch["points"]).argmax(-1))


class States(Method):
    """How far an object is open, from how far its points are from each other."""

    title, effort = "states", Effort(100, 16, 0.02)
    given, says, labelled_spaces = (JOINTS,), (JOINT_LINES,), True

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem)
        self.layers = nn.Sequential(nn.BatchNorm1d(QUANTILES), nn.Linear(QUANTILES, 1))

    def _state(self, points: Tensor) -> Tensor:
        quantiles = torch.linspace(0.05, 0.95, QUANTILES)
        return self.layers(torch.cdist(points, points).flatten(1).quantile(quantiles, dim=1).T)

    def training_step(self, batch: dict[str, Tensor], _index: int) -> Tensor:
        return (self._state(batch["points"]) - batch["joint_state"]).square().mean()

    def predict(self, batch: dict[str, Tensor]) -> Prediction:
        return replace(constant(batch["points"]), joint_state=self._state(batch["points"]))
