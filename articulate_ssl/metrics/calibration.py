"""From the network's parts and canonical spaces to the labelled ones, fixed once per category on training clouds.

Paper, appendix "Evaluation Strategy": a network trained without labels numbers its slots and orients its canonical
part spaces as it likes, so a constant relation to the labelled ones is measured on training shapes and then held fixed.
Nothing here is ever fitted on a test cloud.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import roma
import torch
from torch import Tensor

from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.geometry.se3 import invert_se3, transform_points
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.metrics.functional import (
    best_assignment,
    iou_matrix,
    nearest_index,
    rotation_error,
    translation_error,
    wrap_angle,
)

SAMPLE_SIZE = 5
HYPOTHESES = 1000
INLIER_DEG = 5.0
INLIER_DISTANCE = 0.05


@dataclass(frozen=True)
class Calibration:
    """Constant relation of a network's slots, part spaces and joints to the labelled ones of one category.

    Index k is a labelled part, j a labelled joint. Floating-point fields are float64.

    Attributes:
        slot_of_part: [K] the slot that is part k.
        residual_rotation: [K, 3, 3] labelled canonical space -> slot's canonical space: R_gt ~ R_pred @ residual.
        residual_center: [K, 3] the part's bounding-box centre in the slot's canonical space.
        joint_parent: [J] labelled part.
        joint_child: [J] labelled part.
        joint_type: [J] 0 revolute, 1 prismatic.
        network_joint: [J] the network's joint that is joint j most often (decides ties).
        state_sign: [J] s in {+1, -1} of state_gt ~ s * state_pred + offset.
        state_offset: [J] radians or normalised length.
        axis_sign: [J] +1 if most predicted axes point along the labelled axis, else -1; axis errors are undirected.
        rotation_inliers: [K] share of training clouds within 5 degrees of the residual rotation.
        center_inliers: [K] share of training clouds within 0.05 of the residual centre.
    """

    slot_of_part: Tensor
    residual_rotation: Tensor
    residual_center: Tensor
    joint_parent: Tensor
    joint_child: Tensor
    joint_type: Tensor
    network_joint: Tensor
    state_sign: Tensor
    state_offset: Tensor
    axis_sign: Tensor
    rotation_inliers: Tensor
    center_inliers: Tensor

    @property
    def part_of_slot(self) -> Tensor:
        """[K] the part that every slot is."""
        return self.slot_of_part.argsort()

    def to(self, device) -> Calibration:
        """Every field on `device`."""
        return Calibration(**{f.name: getattr(self, f.name).to(device) for f in fields(self)})

    def to_dict(self) -> dict[str, list]:
        """Plain lists, ready for JSON."""
        return {f.name: getattr(self, f.name).tolist() for f in fields(self)}

    @classmethod
    def from_dict(cls, values: dict[str, list]) -> Calibration:
        """Inverse of `to_dict`.

        Raises:
            ValueError: if a field is missing or unknown.
        """
        names = {f.name for f in fields(cls)}
        if names != set(values):
            raise ValueError(f"not a calibration: fields {sorted(names ^ set(values))} are missing or unknown")
        integers = {"slot_of_part", "joint_parent", "joint_child", "joint_type", "network_joint"}
        shapes = {"residual_rotation": (-1, 3, 3), "residual_center": (-1, 3)}
        return cls(
            **{
                name: torch.tensor(value, dtype=torch.int64 if name in integers else torch.float64).reshape(
                    shapes.get(name, (-1,))
                )
                for name, value in values.items()
            }
        )


def ransac(
    samples: Tensor,  # [S, ...]
    mean: Callable[[Tensor], Tensor],  # [H, n, ...] -> [H, ...]
    distance: Callable[[Tensor, Tensor], Tensor],  # broadcasting, -> [...]
    threshold: float,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:  # [...], [] share of inliers
    """Robust mean as in equi-pose (Li et al. 2021): means of 5 samples, most inliers wins, mean of its inliers."""
    count = len(samples)
    draws = torch.rand(HYPOTHESES, count, generator=generator).argsort(dim=1)[:, :SAMPLE_SIZE].to(samples.device)
    hypotheses = mean(samples[draws])
    inlier = torch.cat([distance(h[:, None], samples[None]) < threshold for h in hypotheses.split(50)])  # [H, S]
    best = inlier.sum(1).argmax()
    if not inlier[best].any():
        return hypotheses[best], inlier[best].double().mean()
    result = mean(samples[inlier[best]][None])[0]
    return result, (distance(result[None], samples) < threshold).double().mean()


def chordal_mean(
    rotations: Tensor,  # [H, n, 3, 3]
) -> Tensor:  # [H, 3, 3]
    """Rotation nearest to all of them in the Frobenius norm."""
    return roma.special_procrustes(rotations.sum(dim=1))


def dense_prediction(prediction: Prediction, labels: dict[str, Tensor]) -> Tensor:  # [B, P]
    """Predicted slot of every dense point: as predicted, or that of its nearest input point."""
    if prediction.dense_part_id.shape[1]:
        return prediction.dense_part_id.long()
    nearest = nearest_index(labels["dense_points"], labels["points"])[1]
    return prediction.part_id.long().gather(1, nearest)


def predicts_joints(prediction: Prediction) -> bool:
    """Whether the method says anything about joints; a rigid category has none, and part registration finds none."""
    return prediction.joint_state.shape[1] > 0


def match_joints(
    prediction: Prediction,
    part_of_slot: Tensor,  # [K]
    joint_parent: Tensor,  # [J] labelled
    joint_child: Tensor,  # [J] labelled
    preferred: Tensor | None = None,  # [J]
) -> tuple[Tensor, Tensor]:  # [B, J] network joint, [B, J] +1 or -1
    """The network's joint between the parts of every labelled joint, and -1 where it calls the parent child.

    Network joints are compared by the parts they connect, so a tree that lists its edges in another order costs
    nothing; where the predicted tree has no such edge, a joint that shares one part stands in. Equal candidates are
    decided by `preferred`, or without it by their score summed over the batch. No ground-truth pose or state is used.
    """
    parent = part_of_slot[prediction.joint_parent.long()][:, :, None]  # [B, J, 1], network joints in rows
    child = part_of_slot[prediction.joint_child.long()][:, :, None]
    same = (parent == joint_parent) & (child == joint_child)
    swapped = (parent == joint_child) & (child == joint_parent)
    touching = (parent == joint_parent) | (parent == joint_child) | (child == joint_parent) | (child == joint_child)
    score = 8.0 * (same | swapped) + 2.0 * touching
    if preferred is None:
        preferred = best_assignment(score.sum(0))
    score[:, preferred, torch.arange(len(preferred), device=score.device)] += 1.0
    joint = torch.stack([best_assignment(s) for s in score])  # [B, J]
    orientation = 1.0 - 2.0 * swapped.gather(1, joint[:, None]).squeeze(1).double()
    return joint, orientation


def gather_rows(
    values: Tensor,  # [B, M, ...]
    index: Tensor,  # [B, L]
) -> Tensor:  # [B, L, ...] float64
    """Every cloud's parts or joints in its own order."""
    return values.double()[torch.arange(len(index), device=index.device)[:, None], index]


def calibrate(
    predictions: Prediction,
    labels: dict[str, Tensor],
    seed: int = 0,
) -> Calibration:
    """Measure the constant relation between network and labels on training clouds.

    Slots are assigned to parts by the Hungarian method on the IoU summed over all clouds. The residual rotation and
    centre of every part are robust means (5 samples, 5 degrees, 0.05 of the diagonal, 1000 hypotheses). The sign of a
    joint's state is the one that leaves the smaller median absolute residual, its offset the (circular) median.

    Args:
        predictions: S training clouds, any pose, any state.
        labels: shard arrays of the same clouds, `points` being the S clouds the network saw.
        seed: of the RANSAC draws.

    Raises:
        ValueError: if the labels are incomplete, differ in parts or joints, or there is no cloud.
    """
    check_labels(predictions, labels)
    num_parts = predictions.num_parts
    if len(predictions.part_id) == 0:
        raise ValueError("calibration needs at least one training cloud")
    overlap = iou_matrix(dense_prediction(predictions, labels), labels["dense_part_id"], num_parts)
    slot_of_part = best_assignment(overlap.nansum(0))

    pose = predictions.part_pose.double()[:, slot_of_part]  # [S, K, 4, 4]
    target_pose, target_center = labels["part_pose"].double(), labels["part_center"].double()
    rotation = pose[..., :3, :3].transpose(-1, -2) @ target_pose[..., :3, :3]
    center = transform_points(invert_se3(pose) @ target_pose, target_center[:, :, None]).squeeze(-2)
    generator = torch.Generator().manual_seed(seed)
    threshold = torch.pi * INLIER_DEG / 180
    rotations = [ransac(rotation[:, k], chordal_mean, rotation_error, threshold, generator) for k in range(num_parts)]
    centers = [
        ransac(center[:, k], lambda c: c.mean(1), translation_error, INLIER_DISTANCE, generator)
        for k in range(num_parts)
    ]

    return Calibration(
        slot_of_part=slot_of_part,
        residual_rotation=torch.stack([r for r, _ in rotations]),
        residual_center=torch.stack([c for c, _ in centers]),
        **calibrate_joints(predictions, labels, slot_of_part.argsort()),
        rotation_inliers=torch.stack([share for _, share in rotations]),
        center_inliers=torch.stack([share for _, share in centers]),
    )


def calibrate_joints(
    predictions: Prediction,
    labels: dict[str, Tensor],
    part_of_slot: Tensor,  # [K]
) -> dict[str, Tensor]:
    """The fields of `Calibration` about joints; signs 1 and offsets 0 for a method that predicts none."""
    parent, child, joint_type = (labels[f"joint_{name}"][0].long() for name in ("parent", "child", "type"))
    fixed = {"joint_parent": parent, "joint_child": child, "joint_type": joint_type}
    if not predicts_joints(predictions):
        one = torch.ones_like(parent, dtype=torch.float64)
        order = torch.arange(len(parent), device=parent.device)
        return fixed | {"network_joint": order, "state_sign": one, "state_offset": 0 * one, "axis_sign": one}
    joint, orientation = match_joints(predictions, part_of_slot, parent, child)
    state_sign, state_offset = fit_states(
        gather_rows(predictions.joint_state, joint) * orientation,
        labels["joint_state"].double(),
        joint_type == REVOLUTE,
    )
    along = (gather_rows(predictions.joint_axis, joint) * labels["joint_axis"].double()).sum(-1)  # [S, J]
    return fixed | {
        "network_joint": joint.mode(dim=0).values,
        "state_sign": state_sign,
        "state_offset": state_offset,
        "axis_sign": torch.where(along.sum(0) < 0, -1.0, 1.0).double(),
    }


def fit_states(
    predicted: Tensor,  # [S, J]
    target: Tensor,  # [S, J]
    is_revolute: Tensor,  # [J] bool
) -> tuple[Tensor, Tensor]:  # [J] sign, [J] offset
    """Sign and robust offset of state_gt ~ sign * state_pred + offset; no scale is fitted."""

    def fit(sign: float) -> tuple[Tensor, Tensor]:
        difference = target - sign * predicted
        # Angles are unrolled around their circular mean, so that the median never straddles a full turn.
        turn = torch.atan2(difference.sin().mean(0), difference.cos().mean(0))
        difference = torch.where(is_revolute, turn + wrap_angle(difference - turn), difference)
        offset = difference.median(dim=0).values
        return offset, (difference - offset).abs().median(dim=0).values

    (plus, plus_spread), (minus, minus_spread) = fit(1.0), fit(-1.0)
    sign = torch.where(minus_spread < plus_spread, -1.0, 1.0).double()
    return sign, torch.where(sign < 0, minus, plus)


def check_labels(prediction: Prediction, labels: dict[str, Tensor]) -> None:
    """Refuse labels that do not belong to the prediction.

    Raises:
        ValueError: naming the missing arrays, the mismatch in clouds, points, parts or joints, or the first cloud whose
            predicted poses or joints are not finite.
    """
    needed = {"points", "part_pose", "part_center", "joint_axis", "joint_pivot", "joint_state", "joint_parent"}
    needed |= {"joint_child", "joint_type", "dense_points", "dense_part_id", "instance", "scale"}
    if missing := sorted(needed - set(labels)):
        raise ValueError(f"labels lack the arrays {', '.join(missing)}")
    clouds, parts = prediction.part_pose.shape[:2]
    expected = {
        "points": (*prediction.part_id.shape, 3),
        "part_pose": (clouds, parts, 4, 4),
        "part_center": (clouds, parts, 3),
        "dense_part_id": tuple(labels["dense_points"].shape[:2]),
    }
    if prediction.dense_part_id.shape[1]:
        expected["dense_points"] = (*prediction.dense_part_id.shape, 3)
    if predicts_joints(prediction):
        expected["joint_axis"] = (*prediction.joint_state.shape, 3)
    for name, shape in expected.items():
        if tuple(labels[name].shape) != shape:
            raise ValueError(f"labels[{name!r}] is {tuple(labels[name].shape)}, the prediction asks for {shape}")
    for name in ("joint_parent", "joint_child", "joint_type"):
        if (labels[name] != labels[name][:1]).any():
            raise ValueError(f"labels[{name!r}] differs between clouds: metrics score one category at a time")
    for name in ("part_pose", "part_shape", "joint_axis", "joint_pivot", "joint_state"):
        finite = getattr(prediction, name).flatten(1).isfinite().all(1)
        if not finite.all():
            first = int((~finite).nonzero()[0])
            raise ValueError(f"prediction has NaN or infinite {name} for cloud {first} of its batch")
