"""What can be measured where nothing is labelled: how well predictions fit, and whether they stay when asked again.

A cloud is predicted twice: as it is, and turned, of other points of the same scan. What is right stays the same, so a
change is an error of one of the two; what stays the same may still be wrong the same way twice.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.inference.confidence import relative_error
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.metrics.functional import (
    ABOVE_DEG,
    axis_angle_error,
    nearest_index,
    part_iou,
    rotation_error,
    state_error,
)
from articulate_ssl.metrics.statistics import summarize

PER_PART = ("repeat_miou", "part_share")
PER_JOINT = ("repeat_axis_deg", "repeat_state")
PER_CLOUD = ("reconstruction_error", "relative_error", "repeat_r_deg", "repeat_above_30_rate", "margin", "probability")


@torch.no_grad()
def label_free_figures(
    first: Prediction,
    second: Prediction,
    points: tuple[Tensor, Tensor],  # [B, N, 3] and [B, M, 3] that they label
    turn: Tensor,  # [B, 3, 3] from the first cloud to the second
) -> dict[str, Tensor]:
    """Every figure of every cloud but `probability`, by its name in the report.

    Returns:
        [B, K] for parts, [B, J] for joints, [B] for the rest; float64, angles in degrees. NaN for the IoU of a part
        that is in neither prediction.
    """
    turned_rotation = turn.double() @ first.base_pose[:, :3, :3].double()
    angle = rotation_error(second.base_pose[:, :3, :3].double(), turned_rotation).rad2deg()
    # A point of the second cloud should be of the part that the nearest point of the first one is of.
    nearest = nearest_index(points[1] @ turn.to(points[1]), points[0])[1]
    expected = first.part_id.long().gather(1, nearest)
    axis = (turn.double()[:, None] @ first.joint_axis.double()[..., None]).squeeze(-1)
    revolute = first.joint_type == REVOLUTE
    state = state_error(second.joint_state.double(), first.joint_state.double(), revolute)
    parts = torch.arange(first.num_parts, device=first.part_id.device)
    return {
        "reconstruction_error": first.reconstruction_error.double(),
        "relative_error": relative_error(first, points[0]).double(),
        "repeat_r_deg": angle,
        "repeat_above_30_rate": (angle > ABOVE_DEG).double(),
        "repeat_miou": part_iou(second.part_id, expected, first.num_parts),
        "repeat_axis_deg": axis_angle_error(second.joint_axis.double(), axis).rad2deg(),
        "repeat_state": torch.where(revolute, state.rad2deg(), state),
        "part_share": (first.part_id[..., None] == parts).double().mean(dim=1),
        "margin": first.margin.double(),
    }


class LabelFreeMetrics(Metric):
    """Figures of all clouds of a test set, kept per cloud, with mean, median and bootstrap interval over objects.

    Args:
        replicates: Bootstrap replicates.
        seed: Of the bootstrap.
    """

    full_state_update = False
    is_differentiable = False

    def __init__(self, replicates: int = 1000, seed: int = 0) -> None:
        super().__init__()
        self.replicates = replicates
        self.seed = seed
        for name in ("instance", *PER_PART, *PER_JOINT, *PER_CLOUD):
            self.add_state(name, default=[], dist_reduce_fx="cat")

    def update(
        self,
        first: Prediction,
        second: Prediction,
        points: tuple[Tensor, Tensor],  # [B, N, 3] and [B, M, 3] that they label
        turn: Tensor,  # [B, 3, 3] from the first cloud to the second
        instance: Tensor,  # [B] object that was scanned
        probability: Tensor | None = None,  # [B] that the first is right; of all clouds or of none
    ) -> None:
        """Add a batch of clouds that were predicted twice; every one counts."""
        figures = label_free_figures(first, second, points, turn)
        if probability is not None:
            figures["probability"] = probability.double()
        for name, values in figures.items():
            getattr(self, name).append(values)
        self.instance.append(instance.long())

    def compute(self) -> dict:
        """Statistics of everything seen.

        Returns:
            For every figure a dict with `mean`, `median` and `ci95` (bootstrap over objects; None with fewer than two)
            of each cloud's average over its parts or joints, and the same for single parts and joints in the lists
            `parts` or `joints`; of `part_share`, whose average says nothing, the average is that of each cloud's
            smallest part. `probability` is missing if the method has none. Beside them `samples`, `failures` (0) and
            `instances`.

        Raises:
            ValueError: if nothing was added.
        """
        if not len(self.instance):
            raise ValueError("no test cloud was scored: the test set is empty")
        instance = dim_zero_cat(self.instance)
        result: dict = {}
        for name in (*PER_CLOUD, *PER_PART, *PER_JOINT):
            if not len(getattr(self, name)):
                continue
            values = dim_zero_cat(getattr(self, name))
            if values.ndim == 1:
                result[name] = self._summary(values, instance)
                continue
            average = values.amin(1) if name == "part_share" else values.nanmean(1)
            single = "parts" if name in PER_PART else "joints"
            result[name] = self._summary(average, instance)
            result[name][single] = [self._summary(column, instance) for column in values.unbind(1)]
        return result | {"samples": len(instance), "failures": 0, "instances": len(instance.unique())}

    def _summary(self, values: Tensor, instance: Tensor) -> dict:
        return summarize(values, instance, self.replicates, self.seed)
