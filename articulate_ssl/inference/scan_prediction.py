"""What there is to know about one predicted scan, in its own frame and units: all that exports and viewers read."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from articulate_ssl.geometry.screw import PRISMATIC
from articulate_ssl.inference.articulation import to_input_frame
from articulate_ssl.inference.checkpoint_file import CheckpointError
from articulate_ssl.inference.prediction import Prediction

JOINT_TYPE_NAMES = ("revolute", "prismatic")


@dataclass(frozen=True)
class ScanPrediction:
    """A predicted scan; (scan - center) / scale is what the network saw.

    Attributes:
        prediction: B = 1, in the frame and the units of the scan, float64, on the CPU.
        cloud: [M, 3] the whole scan.
        part_id: [M] part of every point of it.
        limits: [J, 2] lowest and highest joint state: radians, or lengths in the units of the scan.
        category: What the network was trained on.
        checkpoint: Path of the weights; None where no network had a say.
        center: [3], in the frame of the scan.
        scale: Units of the scan per normalised unit.
    """

    prediction: Prediction
    cloud: np.ndarray
    part_id: np.ndarray
    limits: Tensor
    category: str
    checkpoint: str | None
    center: np.ndarray
    scale: float


def part_of_points(
    prediction: Prediction,  # B = 1, of `points`
    points: np.ndarray,  # [N, 3] the network's input
    cloud: np.ndarray,  # [M, 3] the whole scan, same frame as `points`
) -> np.ndarray:  # [M] part indices
    """Part of every point of the whole scan: that of the nearest point that the network saw."""
    return prediction.part_id[0].cpu().numpy()[cKDTree(points).query(cloud)[1]]


def in_scan_frame(
    prediction: Prediction,  # B = 1, normalised space
    points: np.ndarray,  # [N, 3] the network's input, normalised
    center: np.ndarray,  # [3]
    scale: float,
    cloud: np.ndarray,  # [M, 3] the user's scan, not normalised
    state_range: Tensor,  # [J, 2] lowest and highest joint state, normalised units
    category: str,
    checkpoint: str,
) -> ScanPrediction:
    """Undo the normalisation, and give every point of the scan its part.

    Raises:
        ValueError: if `prediction` holds more than one cloud.
        CheckpointError: if `prediction` is not finite.
    """
    _check(prediction, checkpoint)
    metric = to_input_frame(prediction.to("cpu"), torch.as_tensor(center, dtype=torch.float64), scale)
    prismatic = (metric.joint_type[0] == PRISMATIC)[:, None]
    return ScanPrediction(
        prediction=metric,
        cloud=cloud,
        part_id=part_of_points(prediction, points, (cloud - center) / scale),
        limits=torch.where(prismatic, state_range.cpu().double() * scale, state_range.cpu().double()),
        category=category,
        checkpoint=checkpoint,
        center=center,
        scale=scale,
    )


def _check(prediction: Prediction, checkpoint: str) -> None:
    if len(prediction.part_id) != 1:
        raise ValueError(f"one cloud is exported at a time, got a batch of {len(prediction.part_id)}")
    broken = [f.name for f in fields(prediction) if not getattr(prediction, f.name).isfinite().all()]
    if broken:
        raise CheckpointError(
            f"{checkpoint}: predicts NaN or infinite values ({', '.join(broken)}); its training diverged, train again"
        )
