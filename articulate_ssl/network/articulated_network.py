"""The articulated network: canonical part shapes, structure and pose hypotheses of a cloud (paper, Sec. 3.2).

One equivariant backbone, slot attention for the part proposal, an SO(3)-PointNet per part, and one head per quantity.
Invariant quantities (shapes, assembling translations, pivots, adjacency confidences) come from group-pooled features;
quantities that depend on the pose (base transformation, axes, joint states) are predicted once per group element.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import roma
import torch
from torch import Tensor, nn
from torch.nn import functional

from articulate_ssl.groups import RotationGroup
from articulate_ssl.kinematic_chain import KinematicChain, extract_chain, pair_index
from articulate_ssl.network.slot_attention import SlotAttention
from articulate_ssl.network.so3_pointnet import GroupAttentionPooling, part_pointnet
from datamodules.geometry import PRISMATIC, REVOLUTE, invert_se3, screw_motion, se3


@dataclass(frozen=True)
class Hypotheses:
    """Canonical shapes, structure and one articulated pose per hypothesis h (h runs over the group, or is the winner).

    Attributes:
        part_shape: [B, K, M, 3] canonical part shapes Z_i.
        assembly: [B, K, 3] translations p_i^c into canonical object space.
        pivot: [B, J, 3] canonical object space.
        axis: [B, H, J, 3] unit, canonical object space.
        state: [B, H, J] radians or displacement relative to the canonical object.
        base: [B, H, 4, 4] canonical object space -> camera space.
        confidence: [B, E] adjacency confidences of the part pairs.
        pair_pivot: [B, E, 3] pivots of all part pairs.
        pair_axis: [B, H, E, 3] axes of all part pairs.
        association_logits: [B, C, K] part proposal at the C backbone centres.
        chain: The kinematic chain that poses are built with.
        joint_type: `REVOLUTE` or `PRISMATIC`.
    """

    part_shape: Tensor
    assembly: Tensor
    pivot: Tensor
    axis: Tensor
    state: Tensor
    base: Tensor
    confidence: Tensor
    pair_pivot: Tensor
    pair_axis: Tensor
    association_logits: Tensor
    chain: KinematicChain
    joint_type: int

    def object_shape(self) -> Tensor:
        """Canonical object shape Z = {Z_i + p_i^c}, [B, K, M, 3]."""
        return self.part_shape + self.assembly[:, :, None]

    def articulation(self) -> Tensor:
        """Motion of every part in canonical object space, [B, H, K, 4, 4]."""
        motion = screw_motion(self.axis, self.pivot[:, None].expand_as(self.axis), self.state, self.joint_type)
        return self.chain.part_motion(motion)

    def object_pose(self) -> Tensor:
        """Canonical object space -> camera space of every part, [B, H, K, 4, 4]."""
        return self.base[:, :, None] @ self.articulation()

    def posed(self) -> Tensor:
        """Reconstructions Y_i^g, [B, H, K, M, 3]."""
        pose = self.object_pose()
        return torch.einsum("bhkij,bkmj->bhkmi", pose[..., :3, :3], self.object_shape()) + pose[..., None, :3, 3]

    def select(self, index: Tensor) -> Hypotheses:
        """Keep hypotheses `index` [B, H'] of every cloud, or one, [B]."""
        index = index if index.dim() == 2 else index[:, None]
        rows = torch.arange(len(index), device=index.device)[:, None]
        return replace(
            self,
            axis=self.axis[rows, index],
            state=self.state[rows, index],
            base=self.base[rows, index],
            pair_axis=self.pair_axis[rows, index],
        )

    def at(
        self,
        base: Tensor,  # [B, H, 4, 4]
        state: Tensor,  # [B, H, J]
    ) -> Hypotheses:
        """The same shapes and structure at other poses."""
        return replace(self, base=base, state=state)


class CategoryObject(NamedTuple):
    """What the instances of a category have in common, in canonical object space."""

    shape: Tensor  # [K, M, 3]
    axis: Tensor  # [E, 3] unit, of all part pairs
    pivot: Tensor  # [E, 3]


class ArticulatedNetwork(nn.Module):
    """Backbone, part proposal and heads. Category-level quantities are parameters; heads predict what an instance adds.

    Attributes:
        template: [K, M, 3] category-level canonical part shapes, each about its own origin.
        assembly: [K, 3] category-level assembling translations.
        axis: [E, 3] and pivot: [E, 3] category-level joint lines of the part pairs.
        confidence: [E] category-level adjacency.
        principal_axes: [K, 3, 3] columns along which instances stretch a part.
        mean_confidence: [E] running mean of the predicted adjacency confidences, from which the chain is extracted.
    """

    def __init__(
        self,
        backbone: nn.Module,
        group: RotationGroup,
        in_dim: int,
        dim: int,
        num_parts: int,
        shape_points: int,
        joint_type: int = REVOLUTE,
        state_bound: float = 1.57,
        flow_bound: float = 0.1,
        stretch_bound: float = 0.3,
        part_features: bool = True,
        shared_axis: bool = False,
        directions: bool = False,
    ) -> None:
        """Args: see the configuration of `ArticulatedPoseModule`, which builds this network."""
        super().__init__()
        if joint_type not in (REVOLUTE, PRISMATIC):
            raise ValueError(f"joint_type must be {REVOLUTE} or {PRISMATIC}, got {joint_type}")
        elements = group.elements
        pairs = pair_index(num_parts)
        self.num_parts, self.shape_points, self.joint_type = num_parts, shape_points, joint_type
        self.state_bound, self.flow_bound, self.stretch_bound = state_bound, flow_bound, stretch_bound
        self.part_features, self.shared_axis = part_features, shared_axis
        self.mixed_precision = False  # of the backbone; geometry needs full precision
        self.register_buffer("elements", elements, persistent=False)
        self.register_buffer("pairs", pairs, persistent=False)

        self.backbone = backbone
        self.point_pool = GroupAttentionPooling(in_dim)
        self.part_proposal = SlotAttention(in_dim, num_parts)
        self.pointnet = part_pointnet(in_dim, dim, group, directions)
        self.part_pool = GroupAttentionPooling(2 * dim)

        def head(inputs: int, outputs: int) -> nn.Sequential:
            layers = nn.Sequential(nn.Linear(inputs, dim), nn.LeakyReLU(0.1), nn.Linear(dim, outputs))
            nn.init.normal_(layers[-1].weight, std=1e-3)
            nn.init.zeros_(layers[-1].bias)
            return layers

        self.base_head = nn.ModuleList(head(2 * dim, 6) for _ in range(num_parts))
        self.state_head = nn.ModuleList(head(2 * dim, 1) for _ in range(num_parts))
        self.axis_head = nn.ModuleList(head(2 * dim, 3) for _ in range(num_parts))
        self.shape_head = nn.ModuleList(head(2 * dim, 6 + 3 * shape_points) for _ in range(num_parts))
        self.pair_head = nn.ModuleList(head(4 * dim, 4) for _ in range(len(pairs)))

        self.template = nn.Parameter(0.2 * torch.randn(num_parts, shape_points, 3))
        self.assembly = nn.Parameter(torch.zeros(num_parts, 3))
        self.axis = nn.Parameter(functional.normalize(torch.randn(len(pairs), 3), dim=-1))
        self.pivot = nn.Parameter(torch.zeros(len(pairs), 3))
        self.confidence = nn.Parameter(torch.zeros(len(pairs)))
        self.register_buffer("principal_axes", torch.eye(3).repeat(num_parts, 1, 1))
        self.register_buffer("mean_confidence", torch.zeros(len(pairs)))

    def category_object(self) -> CategoryObject:
        """The category's canonical object and joints."""
        shape = self.template + self.assembly[:, None]
        return CategoryObject(shape, functional.normalize(self.axis, dim=-1), self.pivot)

    def chain(self) -> KinematicChain:
        """The category's kinematic chain, from the running mean of the predicted adjacency confidences."""
        return extract_chain(self.mean_confidence, self.num_parts)

    def forward(
        self,
        points: Tensor,  # [B, N, 3], roughly aligned (stage 0) camera space
        estimate: Hypotheses | None = None,  # the previous iteration's winner (H = 1)
        labels: Tensor | None = None,  # [B, N] parts by that estimate
    ) -> Hypotheses:
        """Hypotheses for every group element; with an estimate, the residual to it (iterated pose estimation)."""
        if estimate is not None:
            pose = invert_se3(estimate.object_pose()[:, 0].detach())
            pose = pose[torch.arange(len(points), device=points.device)[:, None], labels]
            points_in = (pose[..., :3, :3] @ points[..., None]).squeeze(-1) + pose[..., :3, 3]
        else:
            points_in = points
        mean = points_in.mean(dim=1, keepdim=True)
        with torch.autocast(points.device.type, torch.bfloat16, enabled=self.mixed_precision):
            features = self.backbone(points_in)
        features = features.to(points.dtype)
        centers = points_in[:, : features.shape[1]] - mean

        logits = self.part_proposal(self.point_pool(features)).to(points.dtype)
        ones = centers.new_ones(*centers.shape[:2], 1)
        association = torch.cat([logits.softmax(dim=-1), ones], dim=-1)
        pooled = self.pointnet(features, centers, association).to(points.dtype)
        whole = pooled[:, -1:].expand(-1, self.num_parts, -1, -1)
        parts = pooled[:, :-1] if self.part_features else whole
        equivariant = torch.cat([parts, whole], dim=-1)
        invariant = self.part_pool(equivariant)

        chain = self.chain()
        shape, assembly = self._canonical_shape(invariant)
        confidence, pair_pivot = self._pairs(invariant)
        pair_axis = self._axes(equivariant)
        joint_pair = self._pair_of_joint(chain)
        pivot, axis = pair_pivot[:, joint_pair], pair_axis[:, :, joint_pair]
        if self.shared_axis:
            axis = axis[:, :, :1].expand_as(axis)
        state = self._states(equivariant, chain)
        base = self._base(equivariant, chain, mean)
        if estimate is not None:
            state = estimate.state.detach() + state
            base = estimate.base.detach() @ base
        return Hypotheses(
            shape, assembly, pivot, axis, state, base, confidence, pair_pivot, pair_axis, logits, chain, self.joint_type
        )

    def _pair_of_joint(self, chain: KinematicChain) -> list[int]:
        index = {tuple(p): e for e, p in enumerate(self.pairs.tolist())}
        return [index[min(p, c), max(p, c)] for p, c in zip(chain.parent, chain.child, strict=True)]

    def _canonical_shape(self, invariant: Tensor) -> tuple[Tensor, Tensor]:
        """[B, K, M, 3] shapes and [B, K, 3] assembling translations from invariant part features [B, K, 2D]."""
        out = torch.stack([head(invariant[:, k]) for k, head in enumerate(self.shape_head)], dim=1).to(
            self.template.dtype
        )
        shift, stretch, flow = out.split([3, 3, 3 * self.shape_points], dim=-1)
        stretch = (self.stretch_bound * stretch.tanh()).exp()
        along = self.principal_axes * stretch[..., None, :]
        shape = torch.einsum("bkij,klj,kml->bkmi", along, self.principal_axes, self.template)
        shape = shape + self.flow_bound * flow.unflatten(-1, (-1, 3)).tanh()
        return shape, self.assembly + shift

    def _pairs(self, invariant: Tensor) -> tuple[Tensor, Tensor]:
        """Adjacency confidences [B, E] and pivots [B, E, 3] from invariant features of part pairs."""
        both = [torch.cat([invariant[:, i], invariant[:, j]], dim=-1) for i, j in self.pairs.tolist()]
        out = torch.stack([head(x) for head, x in zip(self.pair_head, both, strict=True)], dim=1).to(
            self.template.dtype
        )
        return self.confidence + out[..., 0], self.pivot + out[..., 1:]

    def _axes(self, equivariant: Tensor) -> Tensor:
        """Axis hypotheses [B, G, E, 3] of the part pairs: the category's axis, tilted by the deeper part's features."""
        tilt = torch.stack([head(equivariant[:, k]) for k, head in enumerate(self.axis_head)], dim=2).to(
            self.template.dtype
        )
        tilt = tilt[:, :, self.pairs[:, 1]]
        return functional.normalize(self.axis + tilt, dim=-1)

    def _states(self, equivariant: Tensor, chain: KinematicChain) -> Tensor:
        """Joint-state hypotheses [B, G, J], each from the features of the part that the joint moves."""
        state = [self.state_head[k](equivariant[:, k]).to(self.template.dtype)[..., 0] for k in chain.child]
        return self.state_bound * torch.stack(state, dim=-1).tanh()

    def _base(self, equivariant: Tensor, chain: KinematicChain, mean: Tensor) -> Tensor:
        """Base transformation hypotheses [B, G, 4, 4]: group element x predicted residual, about the cloud's mean."""
        residual = self.base_head[chain.root](equivariant[:, chain.root]).to(self.template.dtype)
        elements = self.elements.to(residual)
        translation = torch.einsum("gij,bgj->bgi", elements, residual[..., 3:]) + mean
        return se3(elements @ roma.rotvec_to_rotmat(residual[..., :3]), translation)
