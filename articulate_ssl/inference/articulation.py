"""Move a predicted object: pose its parts as predicted, or articulate its canonical shape to any joint state."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from articulate_ssl.geometry.kinematic_chain import forward_kinematics
from articulate_ssl.geometry.screw import PRISMATIC, screw_motion
from articulate_ssl.geometry.se3 import invert_se3, transform_points
from articulate_ssl.inference.prediction import Prediction


def canonical_object(prediction: Prediction) -> Tensor:  # [B, K, M, 3]
    """The canonical object shape Z = {Z_i + p_i^c} (paper, "Part-assembling Parameters"), in canonical object space."""
    return prediction.part_shape + prediction.assembly[:, :, None]


def posed_parts(prediction: Prediction) -> Tensor:  # [B, K, M, 3]
    """The reconstruction: every canonical part shape under its predicted pose, in camera space."""
    return transform_points(prediction.part_pose, prediction.part_shape)


def part_motion(
    prediction: Prediction,
    states: Tensor,  # [B, J] or [J], radians or displacement relative to the canonical object shape
) -> Tensor:  # [B, K, 4, 4]
    """Cascaded articulation of the canonical object (paper, "Kinematic chain"): each part's motion in its space."""
    batch = prediction.joint_state.shape[0]
    states = states.to(prediction.canonical_axis).expand(batch, -1)
    return torch.stack([_motion_of_one(prediction[b : b + 1], states[b]) for b in range(batch)])


def articulate(
    prediction: Prediction,
    states: Tensor,  # [B, J] or [J], radians or displacement relative to the canonical object shape
) -> Tensor:  # [B, K, M, 3]
    """The object re-articulated to `states` and seen under the predicted base pose, in camera space.

    At `prediction.joint_state` this is `posed_parts`, as far as the predicted part poses obey the predicted joints.
    """
    pose = prediction.base_pose[:, None] @ part_motion(prediction, states)
    return transform_points(pose, canonical_object(prediction))


def to_canonical(
    prediction: Prediction,  # B = 1
    points: Tensor,  # [..., 3], camera space
) -> Tensor:  # [..., 3] float64
    """Points seen from canonical object space: the predicted base pose undone."""
    return transform_points(invert_se3(prediction.base_pose[0].double()), points.double())


def to_input_frame(
    prediction: Prediction,
    center: Tensor,  # [3]
    scale: float,
) -> Prediction:
    """The same prediction in the frame and the units of the user's scan, in float64: undoes (x - center) / scale.

    Canonical spaces take the user's units too, so that all poses stay rigid.
    """

    def double(name: str) -> Tensor:
        return getattr(prediction, name).to(torch.float64, copy=True)

    moved = {name: double(name) for name in ("part_pose", "base_pose", "joint_axis", "canonical_axis")}
    for name in ("part_pose", "base_pose"):
        moved[name][..., :3, 3] = moved[name][..., :3, 3] * scale + center
    for name in ("part_shape", "assembly", "canonical_pivot", "reconstruction_error"):
        moved[name] = double(name) * scale
    moved["joint_pivot"] = double("joint_pivot") * scale + center
    state = double("joint_state")
    moved["joint_state"] = torch.where(prediction.joint_type == PRISMATIC, state * scale, state)
    return replace(prediction, **moved)


def _motion_of_one(prediction: Prediction, states: Tensor) -> Tensor:
    motions = [
        screw_motion(axis, pivot, state, int(joint_type))
        for axis, pivot, state, joint_type in zip(
            prediction.canonical_axis[0], prediction.canonical_pivot[0], states, prediction.joint_type[0], strict=True
        )
    ]
    motion = torch.stack(motions) if motions else prediction.base_pose.new_empty(0, 4, 4)
    parent, child = prediction.joint_parent[0].tolist(), prediction.joint_child[0].tolist()
    return forward_kinematics(motion, parent, child, prediction.num_parts)
