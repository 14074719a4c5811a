"""The objective of one iteration of pose estimation: L = L_rec + lambda L_reg, and what the staged recipe adds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from articulate_ssl.losses.joint_regularization import joint_regularization
from articulate_ssl.losses.reconstruction import (
    balanced_association,
    distances_to_cloud,
    distances_to_parts,
    owned_parts,
    part_by_part,
    part_of_mass,
    posterior_association,
    whole_shape,
)
from articulate_ssl.network.category_object import CanonicalObject
from articulate_ssl.network.hypotheses import Hypotheses
from articulate_ssl.network.rigid_alignment import RigidHypotheses
from articulate_ssl.ops.chamfer import chamfer, hypothesis_distances, nearest_index

SLOTS, POSTERIOR = "slots", "posterior"


@dataclass(frozen=True)
class ObjectiveOptions:
    """Weights of the objective.

    Attributes:
        unidirectional: Reconstruction distance from the input to the reconstruction only (partial clouds).
        joint_regularization: The paper's lambda; 0 is its ablation of L_reg.
        joint_extent: Half length of the stretch of joint line that L_reg pulls to the parts, in normalised units.
        distillation: Weight of the distance between predicted and registered poses (staged recipe).
        deviation: Weight of the squared distance between an instance's canonical object and joint lines and the
            category's (staged recipe). Without it they drift together with the poses.
        segmentation: Weight of the cross-entropy between part proposal and posterior association (staged recipe).
        posterior_scale: Standard deviation of the posterior association, in normalised units.
        association: What weights the parts of a point: `slots`, the slot attention's answer, as in the paper, or
            `posterior`, the posed parts that explain it, which the slots are then taught (paper recipe). Slots that
            weight their own reconstruction collapse within ten steps.
        agreement: Weight, in choosing among hypotheses, of the distance of points to the parts that the slot attention
            assigns, beside the whole shape's (paper recipe; the original code chooses by such distances alone).
            Without it two parts of one shape are told apart by chance, in every cloud anew.
        part_mass: Divide a part's distance by its own share of the points, so that a small part counts as much as a
            large one (paper recipe; the original code does).
        detached_shapes: L_reg moves joint lines to shapes, not shapes to joint lines (paper recipe; the original code
            does).
    """

    unidirectional: bool = False
    joint_regularization: float = 1.0
    joint_extent: float = 0.1
    distillation: float = 1.0
    deviation: float = 10.0
    segmentation: float = 0.1
    posterior_scale: float = 0.03
    association: str = POSTERIOR
    agreement: float = 1.0
    part_mass: bool = True
    detached_shapes: bool = True

    def __post_init__(self) -> None:
        """Raises: ValueError for an unknown association."""
        if self.association not in (SLOTS, POSTERIOR):
            raise ValueError(f"objective.association must be {SLOTS!r} or {POSTERIOR!r}, got {self.association!r}")


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
    point_part: Tensor | None = None  # [B, N] of the points, where it is known


def rigid_loss(
    hypotheses: RigidHypotheses,
    points: Tensor,  # [B, N, 3]
    bidirectional: bool,
) -> Tensor:
    """Stage 0: the distance of the best hypothesis, min_g d(X, Y^g), averaged over the batch."""
    posed = hypotheses.posed()
    best = hypothesis_distances(points, posed, bidirectional=bidirectional).argmin(dim=1)
    chosen = posed[torch.arange(len(points), device=points.device), best]
    return chamfer(points, chosen, bidirectional=bidirectional).mean()


def spread_to_points(logits: Tensor, points: Tensor) -> Tensor:
    """Part logits [B, C, K] at the backbone's centres (the first C points) -> [B, N, K], from the nearest centre."""
    centers = logits.shape[1]
    if centers == points.shape[1]:
        return logits
    index = nearest_index(points, points[:, :centers])
    return logits.gather(1, index[..., None].expand(-1, -1, logits.shape[2]))


def paper_terms(winner: Hypotheses, points: Tensor, options: ObjectiveOptions, balance: float = 0.0) -> Terms:
    """The paper's objective for the winning hypothesis: whole-shape and part-by-part reconstruction, and L_reg.

    Parts that no point belongs to are left out of the part-by-part term: compared with the whole cloud they would
    decode all of it.

    Args:
        balance: How far the posterior association is drawn to parts of equal shares (`balanced_association`).
    """
    posed = winner.posed()[:, 0]
    to_part = distances_to_parts(points, posed)
    if options.association == SLOTS:
        association = spread_to_points(winner.association_logits, points).softmax(dim=-1)
        segmentation = points.new_zeros(())
    else:
        association = balanced_association(to_part, options.posterior_scale, balance)
        segmentation = _proposal_term(winner.association_logits, association)
    bidirectional = not options.unidirectional
    whole = whole_shape(to_part, distances_to_cloud(posed, points) if bidirectional else None)
    labels = association.argmax(dim=-1)
    to_cloud = distances_to_cloud(posed, points, labels) if bidirectional else None
    seen = owned_parts(labels, posed.shape[1])
    parts = (part_of_mass if options.part_mass else part_by_part)(to_part, to_cloud, association, seen)
    reconstruction = (whole + parts).mean()
    joints = _joint_term(winner, options, options.detached_shapes)
    loss = reconstruction + options.joint_regularization * joints + options.segmentation * segmentation
    zero = loss.new_zeros(())
    return Terms(loss, reconstruction, joints, zero, zero, segmentation, association)


def staged_terms(
    selected: Hypotheses,
    points: Tensor,  # [B, N, 3]
    category: CanonicalObject,
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
    distillation, explained = points.new_zeros(()), to_part
    if target is not None:
        at_target = selected.at(target.base[:, None], target.state[:, None])
        with torch.no_grad():
            goal = at_target.posed()[:, 0]
            explained = distances_to_parts(points, _posed_category(at_target, category) if follow_category else goal)
        distillation = (posed - goal).norm(dim=-1).mean()
    association = posterior_association(explained, options.posterior_scale)
    if target is not None and target.point_part is not None:
        association = functional.one_hot(target.point_part, posed.shape[1]).to(association)
    labels = association.argmax(dim=-1)
    to_cloud = None if options.unidirectional else distances_to_cloud(posed, points, labels)
    reconstruction = part_by_part(to_part, to_cloud, association).mean()
    segmentation = _proposal_term(selected.association_logits, association)
    deviation = _deviation_term(selected, category)
    joints = _joint_term(selected, options)
    loss = (
        reconstruction
        + options.joint_regularization * joints
        + options.distillation * distillation
        + options.deviation * deviation
        + options.segmentation * segmentation
    )
    return Terms(loss, reconstruction, joints, distillation, deviation, segmentation, association)


def _posed_category(at_target: Hypotheses, category: CanonicalObject) -> Tensor:
    """[B, K, M, 3] the category's parts where the first hypothesis has the instance's."""
    pose = at_target.object_pose()[:, 0]
    return torch.einsum("bkij,kmj->bkmi", pose[..., :3, :3], category.shape) + pose[..., None, :3, 3]


def _proposal_term(logits: Tensor, association: Tensor) -> Tensor:
    """Cross-entropy of the part proposal [B, C, K] to the association [B, N, K] of the leading C points."""
    return functional.cross_entropy(logits.flatten(0, 1), association[:, : logits.shape[1]].flatten(0, 1))


def _deviation_term(selected: Hypotheses, category: CanonicalObject) -> Tensor:
    """Squared distance of instances' canonical objects and joint lines to the category's."""
    structure = selected.structure
    return sum(
        (instance - common).square().sum(dim=-1).mean()
        for instance, common in (
            (selected.object_shape(), category.shape),
            (structure.pair_axis[:, 0], category.axis),
            (structure.pair_pivot, category.pivot),
        )
    )


def _joint_term(winner: Hypotheses, options: ObjectiveOptions, detached: bool = False) -> Tensor:
    """L_reg of the first hypothesis; `detached` shapes receive no gradient."""
    structure = winner.structure
    if options.joint_regularization == 0:
        return structure.pivot.new_zeros(())
    canonical = winner.object_shape().detach() if detached else winner.object_shape()
    motion = winner.articulation()[:, 0]
    articulated = torch.einsum("bkij,bkmj->bkmi", motion[..., :3, :3], canonical) + motion[..., None, :3, 3]
    return joint_regularization(
        canonical,
        articulated.detach() if detached else articulated,
        structure.pair_pivot,
        structure.pair_axis[:, 0],
        structure.confidence,
        structure.joint_type,
        options.joint_extent,
    ).mean()
