"""Whether the predicted kinematic tree is the labelled one: which parts joints connect, and which part is the root."""

from __future__ import annotations

import torch
from torch import Tensor

from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.metrics.calibration import Calibration, predicts_joints


def tree_correct(
    prediction: Prediction,
    calibration: Calibration,
) -> Tensor:  # [B] float64
    """1 where the predicted undirected edges, with slots called by their parts, are the labelled edges, else 0.

    NaN without predicted joints, and with two parts, which have only one tree: a number that is always 1 says nothing.
    """
    parts = prediction.num_parts
    if parts <= 2 or not predicts_joints(prediction):
        return _undefined(prediction)
    parent, child = (calibration.part_of_slot[j.long()] for j in (prediction.joint_parent, prediction.joint_child))
    labelled = _edges(calibration.joint_parent[None], calibration.joint_child[None], parts)
    return (_edges(parent, child, parts) == labelled).all(-1).double()


def root_correct(
    prediction: Prediction,
    calibration: Calibration,
) -> Tensor:  # [B] float64
    """1 where the one part that is no joint's child is the labelled root, else 0; 0 too where several are no child.

    NaN without predicted joints. A root that is drawn at random scores 1 / K.
    """
    parts = prediction.num_parts
    if not predicts_joints(prediction):
        return _undefined(prediction)
    child = calibration.part_of_slot[prediction.joint_child.long()]
    return (_roots(child, parts) == _roots(calibration.joint_child[None], parts)).all(-1).double()


def _edges(
    parent: Tensor,  # [B, J]
    child: Tensor,  # [B, J]
    parts: int,
) -> Tensor:  # [B, K * K] bool, the cells (smaller part, larger part) of the edges
    cell = torch.minimum(parent, child) * parts + torch.maximum(parent, child)
    return torch.zeros(len(cell), parts**2, dtype=torch.bool, device=cell.device).scatter(1, cell, True)


def _roots(
    child: Tensor,  # [B, J]
    parts: int,
) -> Tensor:  # [B, K] bool
    return torch.ones(len(child), parts, dtype=torch.bool, device=child.device).scatter(1, child, False)


def _undefined(prediction: Prediction) -> Tensor:
    pose = prediction.part_pose
    return torch.full((len(pose),), torch.nan, dtype=torch.float64, device=pose.device)
