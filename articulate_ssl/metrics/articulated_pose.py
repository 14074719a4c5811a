"""Every number that is reported for an articulated category: per-cloud errors and their statistics."""

from __future__ import annotations

import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.geometry.se3 import transform_points
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.metrics.calibration import (
    Calibration,
    check_labels,
    dense_prediction,
    gather_rows,
    match_joints,
    predicts_joints,
)
from articulate_ssl.metrics.confidence import report_confidence
from articulate_ssl.metrics.functional import (
    ABOVE_DEG,
    FLIP_DEG,
    axis_angle_error,
    chamfer_l1,
    iou_matrix,
    legacy_axis_error,
    legacy_chamfer,
    legacy_fold,
    legacy_pivot_error,
    legacy_rematch,
    line_to_line_distance,
    rotation_error,
    state_error,
    translation_error,
)
from articulate_ssl.metrics.kinematic_tree import root_correct, tree_correct
from articulate_ssl.metrics.objects import CLOUDS, NUMBER
from articulate_ssl.metrics.statistics import summarize
from articulate_ssl.metrics.symmetry import measured_symmetries, pool, rest_clouds, symmetric_rotation_error

PER_PART = (
    "r_err_deg",
    "r_err_sym_deg",
    "t_err",
    "flip_rate",
    "above_30_rate",
    "seg_miou",
    "legacy_r_err_deg",
    "legacy_t_err",
    "legacy_seg_miou",
)
PER_JOINT = ("axis_err_deg", "pivot_err", "state_err", "legacy_pivot_err")
PER_CLOUD = ("chamfer_l1", "tree_accuracy", "root_accuracy", "legacy_axis_err_deg", "legacy_chamfer_l1")
# Known only when all clouds of an instance were seen.
AT_THE_END = ("r_err_sym_deg",)
REST = ("points", "part_id", "part_center", "joint_axis", "joint_pivot")  # of `rest_clouds`
ANY_PART = ("flip_rate", "above_30_rate")  # true of a cloud if of any part


def part_pose_errors(
    prediction: Prediction,
    labels: dict[str, Tensor],
    calibration: Calibration,
    slot: Tensor,  # [B, K], the slot that is compared with every part
) -> tuple[Tensor, Tensor]:  # [B, K] radians, [B, K] diagonal units
    """Rotation and translation errors of every part.

    A part's translation is the position of its bounding-box centre (the paper centralises bounding boxes): the slot's
    pose applied to the residual centre of training, against the true pose applied to the true centre.
    """
    pose = gather_rows(prediction.part_pose, slot)
    residual = calibration.part_of_slot[slot]  # residuals belong to slots, whatever part a slot is compared with
    target = labels["part_pose"].double()
    rotation = rotation_error(pose[..., :3, :3] @ calibration.residual_rotation[residual], target[..., :3, :3])
    center = transform_points(pose, calibration.residual_center[residual][..., None, :])
    target_center = transform_points(target, labels["part_center"].double()[..., None, :])
    return rotation, translation_error(center, target_center).squeeze(-1)


def joint_errors(
    prediction: Prediction,
    labels: dict[str, Tensor],
    calibration: Calibration,
) -> dict[str, Tensor]:
    """Errors of every joint, [B, J], and the legacy axis error, [B]; NaN where the method predicts no joints."""
    target_axis, target_pivot = labels["joint_axis"].double(), labels["joint_pivot"].double()
    undefined = torch.full_like(labels["joint_state"], torch.nan, dtype=torch.float64)
    if not predicts_joints(prediction):
        per_cloud = undefined.new_full((len(undefined),), torch.nan)
        return dict.fromkeys(PER_JOINT, undefined) | {"legacy_axis_err_deg": per_cloud}
    joint, orientation = match_joints(
        prediction,
        calibration.part_of_slot,
        calibration.joint_parent,
        calibration.joint_child,
        calibration.network_joint,
    )
    axis, pivot = gather_rows(prediction.joint_axis, joint), gather_rows(prediction.joint_pivot, joint)
    revolute = (calibration.joint_type == REVOLUTE).expand(joint.shape)
    state = calibration.state_sign * orientation * gather_rows(prediction.joint_state, joint)
    state_err = state_error(state + calibration.state_offset, labels["joint_state"].double(), revolute)
    line_err = line_to_line_distance(axis, pivot, target_axis, target_pivot)
    legacy_pivot = legacy_pivot_error(pivot, target_axis, target_pivot, labels["points"].double().mean(1))
    return {
        "axis_err_deg": axis_angle_error(axis, target_axis).rad2deg(),
        "pivot_err": torch.where(revolute, line_err, undefined),
        "state_err": torch.where(revolute, state_err.rad2deg(), state_err),
        "legacy_axis_err_deg": legacy_axis_error(axis, target_axis).rad2deg(),
        "legacy_pivot_err": torch.where(revolute, legacy_pivot, undefined),
    }


def relative_rotation(
    prediction: Prediction,
    labels: dict[str, Tensor],
    calibration: Calibration,
) -> Tensor:  # [B, K, 3, 3] float64
    """R_true^T R_predicted of every part: its angle is the rotation error."""
    predicted = gather_rows(prediction.part_pose, calibration.slot_of_part.expand(prediction.part_pose.shape[:2]))
    target = labels["part_pose"].double()[..., :3, :3]
    return target.transpose(-1, -2) @ predicted[..., :3, :3] @ calibration.residual_rotation


@torch.no_grad()
def cloud_errors(
    prediction: Prediction,
    labels: dict[str, Tensor],
    calibration: Calibration,
) -> dict[str, Tensor]:
    """Every error of every cloud, by its name in the report.

    Returns:
        [B, K] for part errors, [B, J] for joint errors, [B] for the rest; float64. Angles are in degrees. NaN only
        where a quantity does not exist: the pivot of a prismatic joint, the tree of two parts, the IoU of a part that
        is in neither the labelled nor the predicted segmentation. `AT_THE_END` is missing.

    Raises:
        ValueError: if the labels do not belong to the prediction (`check_labels`).
    """
    check_labels(prediction, labels)
    calibration = calibration.to(prediction.part_pose.device)
    clouds, parts = prediction.part_pose.shape[:2]

    iou = iou_matrix(dense_prediction(prediction, labels), labels["dense_part_id"], parts)  # [B, K slots, K parts]
    slot = calibration.slot_of_part.expand(clouds, parts)
    legacy_slot = legacy_rematch(iou)
    rotation, translation = part_pose_errors(prediction, labels, calibration, slot)
    legacy_rotation, legacy_translation = part_pose_errors(prediction, labels, calibration, legacy_slot)

    points = labels["points"]
    # In float64, because a mixed-precision network may hand over poses and shapes of different types.
    posed = transform_points(prediction.part_pose.double(), prediction.part_shape.double())  # [B, K, M, 3]
    reconstruction = posed.flatten(1, 2)
    return {
        "r_err_deg": rotation.rad2deg(),
        "t_err": translation,
        "flip_rate": (rotation.rad2deg() > FLIP_DEG).double(),
        "above_30_rate": (rotation.rad2deg() > ABOVE_DEG).double(),
        "seg_miou": iou.gather(1, slot[:, None]).squeeze(1),
        "chamfer_l1": chamfer_l1(points, reconstruction),
        "tree_accuracy": tree_correct(prediction, calibration),
        "root_accuracy": root_correct(prediction, calibration),
        "legacy_r_err_deg": legacy_fold(legacy_rotation).rad2deg(),
        "legacy_t_err": legacy_translation,
        "legacy_seg_miou": iou.gather(1, legacy_slot[:, None]).squeeze(1),
        "legacy_chamfer_l1": legacy_chamfer(points, reconstruction),
        **joint_errors(prediction, labels, calibration),
    }


class ArticulatedPoseMetrics(Metric):
    """Errors of all clouds of a test set, kept per cloud, with mean, median and bootstrap interval over instances.

    Args:
        calibration: Of this network on the training clouds of this category.
        replicates: Bootstrap replicates.
        seed: Of the bootstrap.
    """

    full_state_update = False
    is_differentiable = False

    def __init__(self, calibration: Calibration, replicates: int = 1000, seed: int = 0) -> None:
        super().__init__()
        self.calibration = calibration
        self.replicates = replicates
        self.seed = seed
        measured = [name for name in (*PER_PART, *PER_JOINT, *PER_CLOUD) if name not in AT_THE_END]
        said = ("margin", "probability")
        for name in ("instance", "relative_rotation", *(f"rest_{name}" for name in REST), *said, *measured):
            self.add_state(name, default=[], dist_reduce_fx="cat")

    def update(self, prediction: Prediction, labels: dict[str, Tensor], probability: Tensor | None = None) -> None:
        """Add the clouds of a batch; every one counts.

        Args:
            prediction: B clouds.
            labels: shard arrays of the same clouds; `points` [B, N, 3] are the clouds the network saw.
            probability: [B] that the predictions are right, if the method says so; of all clouds or of none.

        Raises:
            ValueError: if the labels do not belong to the prediction.
        """
        for name, errors in cloud_errors(prediction, labels, self.calibration).items():
            getattr(self, name).append(errors)
        calibration = self.calibration.to(prediction.part_pose.device)
        self.relative_rotation.append(relative_rotation(prediction, labels, calibration))
        for name, values in rest_clouds(labels).items():
            getattr(self, f"rest_{name}").append(values)
        self.instance.append(labels["instance"].long())
        self.margin.append(prediction.margin.double())
        if probability is not None:
            self.probability.append(probability.double())

    def compute(self) -> dict:
        """Statistics of everything seen.

        Returns:
            For every quantity of design section 4 a dict with `mean`, `median` and `ci95` (bootstrap over instances, of
            the mean; None with fewer than two instances) of each cloud's average over its parts or joints, and the same
            three for every single part or joint in the lists `parts` or `joints`. `flip_rate` and `above_30_rate` have
            a cloud count if any part does. Values that do not exist (the pivot of a prismatic joint) are None. Beside
            them `samples`, `failures` (0: no cloud is ever dropped), `instances`, `symmetric_instances`, those of
            them with a symmetry besides the identity (`metrics/symmetry.py`), and what `margin` and `probability` (None
            if the method has none) are worth as a confidence (`metrics/confidence.py`).

        Raises:
            ValueError: if nothing was added.
        """
        if not len(self.instance):
            raise ValueError("no test cloud was scored: the test set is empty")
        instance = dim_zero_cat(self.instance)
        at_the_end, counts = self._modulo_symmetry(instance)
        result: dict = {}
        for name in (*PER_PART, *PER_JOINT, *PER_CLOUD):
            values = at_the_end[name] if name in AT_THE_END else dim_zero_cat(getattr(self, name))
            result[name] = self._summary(self._of_clouds(name, values), instance)
            if values.ndim > 1:
                single = "parts" if name in PER_PART else "joints"
                result[name][single] = [self._summary(column, instance) for column in values.unbind(1)]
        said = {name: getattr(self, name) for name in ("margin", "probability")}
        errors = dim_zero_cat(self.r_err_deg)
        confidence = {k: report_confidence(dim_zero_cat(v), errors) if len(v) else None for k, v in said.items()}
        return result | {"samples": len(instance), "failures": 0} | counts | confidence

    def per_object(self) -> dict[str, Tensor]:
        """Means over the clouds of every object; of all processes, so every one has to ask.

        Returns:
            `instance` [I] of the labels and `samples` [I], its clouds; by the name of an error [I] the mean of each
            cloud's average, NaN where it does not exist. `AT_THE_END` is missing.
        """
        with self.sync_context(dist_sync_fn=self.dist_sync_fn):
            instance, row = dim_zero_cat(self.instance).cpu().unique(return_inverse=True)
            found = {NUMBER: instance, CLOUDS: row.bincount()}
            for name in (*PER_PART, *PER_JOINT, *PER_CLOUD):
                if name not in AT_THE_END:
                    values = self._of_clouds(name, dim_zero_cat(getattr(self, name))).cpu()
                    found[name] = _means(values, row, len(instance))
        return found

    def _of_clouds(self, name: str, values: Tensor) -> Tensor:  # [S]
        """Of values of clouds, or of their parts or joints, the average of each cloud."""
        if values.ndim == 1:
            return values
        if name == "state_err" and len({*self.calibration.joint_type.tolist()}) > 1:
            return torch.full_like(values[:, 0], torch.nan)  # degrees and lengths have no common mean
        return values.amax(1) if name in ANY_PART else values.nanmean(1)

    def _modulo_symmetry(self, instance: Tensor) -> tuple[dict[str, Tensor], dict[str, int]]:
        """`AT_THE_END`, every one [S, K], and how many instances there are and are symmetric."""
        error, relative = dim_zero_cat(self.r_err_deg).clone(), dim_zero_cat(self.relative_rotation)
        rest = {name: dim_zero_cat(getattr(self, f"rest_{name}")) for name in REST}
        instances, symmetric = instance.unique(), 0
        for one in instances:
            own = instance == one
            clouds = {name: values[own] for name, values in rest.items()}
            symmetries = measured_symmetries(pool(clouds, self.calibration.joint_type))
            # Without a symmetry the error stays what it is, to the last digit.
            if len(symmetries) > 1:
                error[own] = symmetric_rotation_error(relative[own], symmetries).rad2deg()
                symmetric += 1
        return {"r_err_sym_deg": error}, {"instances": len(instances), "symmetric_instances": symmetric}

    def _summary(self, values: Tensor, instance: Tensor) -> dict:
        return summarize(values, instance, self.replicates, self.seed)


def _means(values: Tensor, row: Tensor, rows: int) -> Tensor:
    """Means [rows] of the values [S] of each row that exist; NaN where none does."""
    exists = ~values.isnan()
    total = torch.zeros(rows, dtype=values.dtype).index_add(0, row[exists], values[exists])
    return total / row[exists].bincount(minlength=rows)
