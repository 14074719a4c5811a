"""What the network says about a batch of clouds: the one type that metrics, export and pictures read."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class Prediction:
    """Parts, poses, canonical shapes and joints of B clouds.

    Camera space is the space of the input points (normalised units). Joint j is the edge from part `joint_child[:, j]`
    to the part nearer to the root, `joint_parent[:, j]`; there are J = K - 1 joints.

    Attributes:
        part_id: [B, N] part of every input point, 0..K-1.
        part_probability: [B, N, K] association W of every point with every part.
        part_pose: [B, K, 4, 4] canonical part space -> camera space.
        part_shape: [B, K, M, 3] canonical part shapes Z_i, in canonical part space.
        assembly: [B, K, 3] translations p_i^c; `part_shape + assembly` is the canonical object shape Z.
        base_pose: [B, 4, 4] canonical object space -> camera space: the base part's rigid transformation.
        joint_parent: [B, J] int64.
        joint_child: [B, J] int64.
        joint_type: [B, J] int64, 0 revolute, 1 prismatic.
        joint_axis: [B, J, 3] unit, camera space.
        joint_pivot: [B, J, 3] a point on the joint line, camera space.
        joint_state: [B, J] radians or displacement relative to the canonical object shape.
        canonical_axis: [B, J, 3] the same axes in canonical object space.
        canonical_pivot: [B, J, 3] the same pivots in canonical object space.
        reconstruction_error: [B] distance between the cloud and its reconstruction (the loss's distance, L1 type).
        margin: [B] in [0, 1], how much better this reconstructs the cloud than the best rival that is turned another
            way: 1 - error / rival's error; 0 if a rival is as good, 1 if none was considered. No probability. Where
            relief or a network decided between two explanations (`two_ways`, `surface_decision`), how much likelier
            than not this one is; where clouds may show mirror images (`handedness`), at most as much.
        dense_part_id: [B, P] part of every point of the dense clouds; P = 0 where these were not given, or nothing
            labels them.
    """

    part_id: Tensor
    part_probability: Tensor
    part_pose: Tensor
    part_shape: Tensor
    assembly: Tensor
    base_pose: Tensor
    joint_parent: Tensor
    joint_child: Tensor
    joint_type: Tensor
    joint_axis: Tensor
    joint_pivot: Tensor
    joint_state: Tensor
    canonical_axis: Tensor
    canonical_pivot: Tensor
    reconstruction_error: Tensor
    margin: Tensor
    dense_part_id: Tensor | None = None

    def __post_init__(self) -> None:
        if self.dense_part_id is None:
            object.__setattr__(self, "dense_part_id", self.part_id[:, :0])

    @property
    def num_parts(self) -> int:
        """K."""
        return self.part_pose.shape[1]

    def __getitem__(self, index) -> Prediction:
        """A sub-batch (slice, mask or index tensor) of every field."""
        return Prediction(**{f.name: getattr(self, f.name)[index] for f in fields(self)})

    def with_rows(self, index: Tensor, other: Prediction) -> Prediction:
        """The same, but clouds [n] as `other`, which is of these, has them."""
        names = [f.name for f in fields(self)]
        return Prediction(**{n: getattr(self, n).index_copy(0, index, getattr(other, n)) for n in names})

    def to(self, device) -> Prediction:
        """Every field on `device`."""
        return Prediction(**{f.name: getattr(self, f.name).to(device) for f in fields(self)})


def concatenate(predictions: list[Prediction]) -> Prediction:
    """Predictions of several batches as one."""
    return Prediction(**{f.name: torch.cat([getattr(p, f.name) for p in predictions]) for f in fields(Prediction)})


@dataclass(frozen=True)
class ScanEstimate:
    """What is predicted for one scan of unknown scale; (scan - center) / scale is what was read.

    Attributes:
        prediction: B = 1, normalised units.
        rival: The best hypothesis that is turned another way, B = 1; None if none was considered.
        points: [N, 3] the normalised points that both label.
        center: [3], in the frame of the scan.
        scale: Units of the scan per normalised unit.
        probability: That orientation and parts are right; None if that has not been learnt (`inference.confidence`).
        unlike: Share of the training clouds that were explained better; None likewise.
        dense: [P, 3] normalised points that `Prediction.dense_part_id` is of; None if that has none.
    """

    prediction: Prediction
    rival: Prediction | None
    points: np.ndarray
    center: np.ndarray
    scale: float
    probability: float | None = None
    unlike: float | None = None
    dense: np.ndarray | None = None
