"""The objective of one iteration of pose estimation: L = L_rec + lambda L_reg, and what the staged recipe adds."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from articulate_ssl.losses.joint_regularization import joint_regularization
from articulate_ssl.losses.reconstruction import (
    distances_to_cloud,
    distances_to_parts,
    part_by_part,
    posterior_association,
    whole_shape,
)
from articulate_ssl.network.articulated_network import CategoryObject, Hypotheses
from articulate_ssl.ops.chamfer import nearest_index
from articulate_ssl.options import ObjectiveOptions


class Terms(NamedTuple):
    """Loss and its terms, each averaged over the batch; the association [B, N, K] that the loss used."""

    loss: Tensor
    reconstruction: Tensor
    joints: Tensor
    distillation: Tensor
    deviation: Tensor
    segmentation: Tensor
    association: Tensor


class PoseTarget(NamedTuple):
    """Registered poses that a hypothesis is drawn to (staged recipe)."""

    base: Tensor  # [B, 4, 4]
    state: Tensor  # [B, J]


def spread_to_points(logits: Tensor, points: Tensor) -> Tensor:
    """Part logits [B, C, K] at the backbone's centres (the first C points) -> [B, N, K], from the nearest centre."""
    centers = logits.shape[1]
    if centers == points.shape[1]:
        return logits
    index = nearest_index(points, points[:, :centers])
    return logits.gather(1, index[..., None].expand(-1, -1, logits.shape[2]))


def paper_terms(winner: Hypotheses, points: Tensor, options: ObjectiveOptions) -> Terms:
    """The paper's objective for the winning hypothesis: whole-shape and part-by-part reconstruction, and L_reg.

    Parts are weighted by the slot attention's association; that is the only gradient it receives.
    """
    posed = winner.posed()[:, 0]
    association = spread_to_points(winner.association_logits, points).softmax(dim=-1)
    to_part = distances_to_parts(points, posed)
    bidirectional = not options.unidirectional
    whole = whole_shape(to_part, distances_to_cloud(posed, points) if bidirectional else None)
    labels = association.argmax(dim=-1)
    parts = part_by_part(to_part, distances_to_cloud(posed, points, labels) if bidirectional else None, association)
    reconstruction = (whole + parts).mean()
    joints = _joint_term(winner, options)
    loss = reconstruction + options.joint_regularization * joints
    zero = loss.new_zeros(())
    return Terms(loss, reconstruction, joints, zero, zero, zero, association)


def staged_terms(
    selected: Hypotheses,
    points: Tensor,  # [B, N, 3]
    category: CategoryObject,
    options: ObjectiveOptions,
    target: PoseTarget | None,
    follow_category: bool,
) -> Terms:
    """Part-by-part reconstruction under the posterior association, L_reg, and two teachers that registration gives.

    The posterior (which posed part explains a point) weights the reconstruction and teaches the part proposal; poses
    are drawn to registered ones, measured on the points they move. Segmentation weighting its own reconstruction
    collapses: one slot takes every point within a few hundred steps.

    Args:
        follow_category: Associate points with the category's parts rather than the instance's, whose predicted shapes
            mean nothing before the network has learnt something.
    """
    posed = selected.posed()[:, 0]
    to_part = distances_to_parts(points, posed)
    distillation = points.new_zeros(())
    explained = to_part
    if target is not None:
        at_target = selected.at(target.base[:, None], target.state[:, None])
        with torch.no_grad():
            goal = at_target.posed()[:, 0]
            shape = goal
            if follow_category:
                pose = at_target.object_pose()[:, 0]
                shape = torch.einsum("bkij,kmj->bkmi", pose[..., :3, :3], category.shape) + pose[..., None, :3, 3]
            explained = distances_to_parts(points, shape)
        distillation = (posed - goal).norm(dim=-1).mean()
    association = posterior_association(explained, options.posterior_scale)
    labels = association.argmax(dim=-1)
    to_cloud = None if options.unidirectional else distances_to_cloud(posed, points, labels)
    reconstruction = part_by_part(to_part, to_cloud, association).mean()
    centers = selected.association_logits.shape[1]
    segmentation = functional.cross_entropy(
        selected.association_logits.flatten(0, 1), association[:, :centers].flatten(0, 1)
    )
    deviation = sum(
        (instance - common).square().sum(dim=-1).mean()
        for instance, common in (
            (selected.object_shape(), category.shape),
            (selected.pair_axis[:, 0], category.axis),
            (selected.pair_pivot, category.pivot),
        )
    )
    joints = _joint_term(selected, options)
    loss = (
        reconstruction
        + options.joint_regularization * joints
        + options.distillation * distillation
        + options.deviation * deviation
        + options.segmentation * segmentation
    )
    return Terms(loss, reconstruction, joints, distillation, deviation, segmentation, association)


def _joint_term(winner: Hypotheses, options: ObjectiveOptions) -> Tensor:
    if options.joint_regularization == 0:
        return winner.pivot.new_zeros(())
    canonical = winner.object_shape()
    motion = winner.articulation()[:, 0]
    articulated = torch.einsum("bkij,bkmj->bkmi", motion[..., :3, :3], canonical) + motion[..., None, :3, 3]
    return joint_regularization(
        canonical,
        articulated,
        winner.pair_pivot,
        winner.pair_axis[:, 0],
        winner.confidence,
        winner.joint_type,
        options.joint_extent,
    ).mean()
