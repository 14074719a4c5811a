"""The articulated network: canonical part shapes, structure and pose hypotheses of a cloud (paper, Sec. 3.2).

One equivariant backbone, slot attention for the part proposal, an SO(3)-PointNet per part, and one head per quantity.
Invariant quantities (shapes, assembling translations, pivots, adjacency confidences) come from group-pooled features;
quantities that depend on the pose (base transformation, axes, joint states) are predicted once per group element.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from articulate_ssl.geometry.se3 import invert_se3
from articulate_ssl.network.backbone import EquivariantBackbone
from articulate_ssl.network.category_object import CategoryObject
from articulate_ssl.network.heads.pose import PoseHead
from articulate_ssl.network.heads.shape import CanonicalShape, ShapeHead
from articulate_ssl.network.heads.structure import AxisHead, PairHead, Structure
from articulate_ssl.network.hypotheses import Hypotheses
from articulate_ssl.network.options import NetworkOptions
from articulate_ssl.network.slot_attention import SlotAttention
from articulate_ssl.network.so3_pointnet import GroupAttentionPooling, part_pointnet
from articulate_ssl.shape.joints import pair_of_joints


class ArticulatedNetwork(nn.Module):
    """Backbone, part proposal and heads. Category-level quantities are parameters; heads predict what an instance adds.

    Args:
        options: Sizes.
        num_parts: K.
        joint_type: `REVOLUTE` or `PRISMATIC`, of all joints.
        state_bound: Largest change of a joint state in one estimation, radians or normalised length.

    Raises:
        ValueError: for an unknown joint type.
    """

    def __init__(
        self, options: NetworkOptions, num_parts: int, joint_type: int = REVOLUTE, state_bound: float = 1.57
    ) -> None:
        super().__init__()
        if joint_type not in (REVOLUTE, PRISMATIC):
            raise ValueError(f"joint_type must be {REVOLUTE} or {PRISMATIC}, got {joint_type}")
        group, in_dim = rotation_group(options.group_order), options.dims[-1]
        self.num_parts, self.joint_type = num_parts, joint_type
        self.part_features, self.shared_axis = options.part_features, options.shared_axis
        self.mixed_precision = False  # of the backbone; geometry needs full precision

        self.backbone = EquivariantBackbone.of(options)
        self.point_pool = GroupAttentionPooling(in_dim)
        self.part_proposal = SlotAttention(in_dim, num_parts)
        self.pointnet = part_pointnet(in_dim, options.head_dim, group, options.directions)
        self.part_pool = GroupAttentionPooling(2 * options.head_dim)
        self.pose_head = PoseHead(num_parts, group, state_bound, options)
        self.axis_head = AxisHead(num_parts, options)
        self.shape_head = ShapeHead(num_parts, options)
        self.pair_head = PairHead(num_parts, options)
        self.category = CategoryObject(num_parts, options.shape_points, options.shared_axis)

    def forward(
        self,
        points: Tensor,  # [B, N, 3], roughly aligned (stage 0) camera space
        estimate: Hypotheses | None = None,  # the previous iteration's winner (H = 1)
        labels: Tensor | None = None,  # [B, N] parts by that estimate
        chain: KinematicChain | None = None,  # the category's, if it was asked for already
    ) -> Hypotheses:
        """Hypotheses for every group element and start of the joint states.

        With an estimate they are residuals to it (iterated pose estimation).
        """
        if estimate is not None:
            points = in_part_frames(points, estimate, labels)
        mean = points.mean(dim=1, keepdim=True)
        logits, equivariant = self._part_features(points, mean)
        invariant = self.part_pool(equivariant)

        chain = chain or self.category.chain()
        shape = self.shape_head(invariant, self.category)
        structure = self._structure(equivariant, invariant, chain)
        base, state = self.pose_head(equivariant, chain, mean, residual=estimate is not None)
        structure = structure.repeated(len(self.pose_head.anchors))
        if estimate is not None:
            state = estimate.state.detach() + state
            base = estimate.base.detach() @ base
        return Hypotheses(shape, structure, base, state, logits)

    def point_features(
        self,
        points: Tensor,  # [B, N, 3], or the same in the frames of their parts
    ) -> Tensor:  # [B, C, D] of the first C points
        """Invariant features, pooled over the group; points in part frames have part-level equivariant ones."""
        return self.point_pool(self.backbone(points).to(points.dtype))

    def category_at(
        self,
        base: Tensor,  # [B, H, 4, 4]
        state: Tensor,  # [B, H, J]
    ) -> Hypotheses:
        """The category's own shape and joints at poses: hypotheses that nothing was read from a cloud for."""
        category, chain, (clouds, count) = self.category, self.category.chain(), base.shape[:2]
        canonical, pair = category.canonical(), pair_of_joints(chain)
        pair_axis = canonical.axis.expand(clouds, count, -1, -1)
        pair_pivot = canonical.pivot.expand(clouds, -1, -1)
        shape = CanonicalShape(category.template.expand(clouds, -1, -1, -1), category.assembly.expand(clouds, -1, -1))
        structure = Structure(
            category.confidence.expand(clouds, -1),
            pair_pivot,
            pair_axis,
            pair_pivot[:, pair],
            category.joint_axis().expand(clouds, count, -1, -1),
            chain,
            self.joint_type,
        )
        return Hypotheses(shape, structure, base, state, base.new_zeros(clouds, 0, self.num_parts))

    def _part_features(self, points: Tensor, mean: Tensor) -> tuple[Tensor, Tensor]:
        """Part proposal [B, C, K], and features [B, K, G, 2D] of the parts beside those of the whole."""
        with torch.autocast(points.device.type, torch.bfloat16, enabled=self.mixed_precision):
            features = self.backbone(points)
            invariant = self.point_pool(features).to(points.dtype)
        centers = points[:, : features.shape[1]] - mean
        logits = self.part_proposal(invariant).to(points.dtype)
        ones = centers.new_ones(*centers.shape[:2], 1)
        association = torch.cat([logits.softmax(dim=-1), ones], dim=-1)
        with torch.autocast(points.device.type, torch.bfloat16, enabled=self.mixed_precision):
            pooled = self.pointnet(features, centers, association).to(points.dtype)
        whole = pooled[:, -1:].expand(-1, self.num_parts, -1, -1)
        parts = pooled[:, :-1] if self.part_features else whole
        return logits, torch.cat([parts, whole], dim=-1)

    def _structure(self, equivariant: Tensor, invariant: Tensor, chain: KinematicChain) -> Structure:
        """Joint lines of all part pairs, and of the chain."""
        confidence, pair_pivot = self.pair_head(invariant, self.category)
        pair_axis = self.axis_head(equivariant, self.category)
        # Not by a list of indices, which would have to be taken to the device.
        joint_pair = pair_of_joints(chain)
        pivot = torch.stack([pair_pivot[:, pair] for pair in joint_pair], dim=1)
        axis = torch.stack([pair_axis[:, :, pair] for pair in joint_pair], dim=2)
        if self.shared_axis:
            axis = axis[:, :, :1].expand_as(axis)
        return Structure(confidence, pair_pivot, pair_axis, pivot, axis, chain, self.joint_type)


def in_part_frames(
    points: Tensor,  # [B, N, 3]
    estimate: Hypotheses,  # H = 1
    labels: Tensor,  # [B, N] parts by that estimate
) -> Tensor:  # [B, N, 3]
    """Every point in the estimated frame of its part: what pose-aware convolution reads (paper, Sec. 3.1)."""
    pose = invert_se3(estimate.object_pose()[:, 0].detach())
    pose = pose[torch.arange(len(points), device=points.device)[:, None], labels]
    return (pose[..., :3, :3] @ points[..., None]).squeeze(-1) + pose[..., :3, 3]
