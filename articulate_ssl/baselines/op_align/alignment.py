"""OP-Align's networks: alignment of the whole object, then of its parts.

Frames: the cloud is centred, in OP-Align's unit. Canonical space is that of the reconstruction Y. An aligned cloud is
X' = R^T X - t, so the object's pose is x = R (y + t).
"""

from __future__ import annotations

from dataclasses import dataclass

import roma
import torch
from torch import Tensor, nn
from torch.nn import functional

from articulate_ssl.geometry.directions import icosahedron_directions
from articulate_ssl.geometry.orientation_range import OrientationRange
from articulate_ssl.geometry.screw import screw_motion
from articulate_ssl.geometry.se3 import invert_se3, rotation_between, se3, transform_points
from articulate_ssl.network.backbone import EquivariantBackbone
from articulate_ssl.network.heads.perceptron import perceptron
from articulate_ssl.network.options import NetworkOptions
from articulate_ssl.network.so3_pointnet import DirectionPointNet
from articulate_ssl.ops.chamfer import hypothesis_distances

ANCHOR_RESIDUAL = torch.pi / 10  # largest turn away from an anchor: neighbours are 36 degrees apart (authors' code)

_START_SPREAD = 0.31  # of the base shape's coordinates: points are 0.5 from the centre in the mean, as a cloud's
_START_WEIGHT = 1e-2  # of the states; chosen without a measurement


@dataclass(frozen=True)
class AnchorPoses:
    """The object level: an instance's canonical reconstruction and one pose per anchor.

    Attributes:
        rotation: [B, G, 3, 3] R.
        translation: [B, G, 3] t, in canonical space.
        shape: [B, M, 3] Y, canonical pose and joint state.
        residual: [B, M, 3] what the instance adds to the category's base shape.
        distance: [B, G] from the input to Y posed by each anchor (one-directional, no gradient); infinite for anchors
            outside of the orientation range.
    """

    rotation: Tensor
    translation: Tensor
    shape: Tensor
    residual: Tensor
    distance: Tensor

    def best(self) -> tuple[Tensor, Tensor]:
        """Rotation [B, 3, 3] and translation [B, 3] of the anchor with the smallest distance."""
        rows = torch.arange(len(self.shape), device=self.shape.device)
        winner = self.distance.argmin(dim=1)
        return self.rotation[rows, winner], self.translation[rows, winner]

    def pose(self) -> Tensor:
        """Canonical space -> input of every anchor, [B, G, 4, 4]."""
        return se3(self.rotation, torch.einsum("bgij,bgj->bgi", self.rotation, self.translation))


class ObjectLevel(nn.Module):
    """Equivariant features on directions, read at the 60 anchors; a base shape and a residual of the invariant code."""

    def __init__(self, options: NetworkOptions, num_points: int, orientation: OrientationRange) -> None:
        """Args: sizes, with `directions`; points of Y; rotations that anchors may have."""
        super().__init__()
        dim = options.head_dim
        self.backbone = EquivariantBackbone.of(options)
        group = self.backbone.group
        self.pointnet = DirectionPointNet(options.dims[-1], dim, icosahedron_directions(group))
        self.pose_head = perceptron(dim, dim, 6)
        self.code = nn.Sequential(
            nn.Linear(dim, dim), nn.BatchNorm1d(dim), nn.LeakyReLU(), nn.Linear(dim, dim), nn.BatchNorm1d(dim)
        )
        self.residual_head = perceptron(dim, dim, 3 * num_points)
        self.base_shape = nn.Parameter(_START_SPREAD * torch.randn(num_points, 3))
        self.orientation = orientation
        self.register_buffer("elements", group.elements.float(), persistent=False)

    def forward(
        self,
        points: Tensor,  # [B, N, 3] centred, normalised units: what the backbone's radii are stated in
        unit: Tensor,  # [] OP-Align's unit per normalised unit
    ) -> AnchorPoses:
        """Reconstruction and poses, in OP-Align's unit."""
        features = self.backbone(points)
        centers = points[:, : features.shape[1]]
        whole = self.pointnet(features, centers, centers.new_ones(*centers.shape[:2], 1)).squeeze(1)  # [B, G, D]
        out = self.pose_head(whole)
        turn = out[..., :3]
        length = turn.norm(dim=-1, keepdim=True).clamp_min(1e-6)
        rotation = self.elements @ roma.rotvec_to_rotmat(turn / length * ANCHOR_RESIDUAL * length.tanh())
        translation = out[..., 3:]
        invariant = whole.amax(dim=1)
        residual = self.residual_head(functional.leaky_relu(self.code(invariant))).view(len(points), -1, 3)
        shape = self.base_shape + residual
        posed = torch.einsum("bgij,bgmj->bgmi", rotation, shape[:, None] + translation[:, :, None]).detach()
        distance = hypothesis_distances(points * unit, posed, bidirectional=False)
        distance = distance.masked_fill(~self.orientation.contains(self.elements), torch.inf)
        return AnchorPoses(rotation, translation, shape, residual, distance)


@dataclass(frozen=True)
class JointGuess:
    """What the PointNet says of one cloud in canonical space, or of B.

    Attributes:
        probability: [B, N, K] W.
        pivot: [B, J, 3] c.
        axis: [B, J, 3] d, unit.
        state: [B, J, 2] a, of the shared part's side and of the other part's; radians or OP-Align's unit.
    """

    probability: Tensor
    pivot: Tensor
    axis: Tensor
    state: Tensor


class _Block(nn.Module):
    """Residual perceptron of points that also sees the maximum over their cloud, then batch normalisation."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.local_in, self.pooled_in = nn.Linear(dim, dim), nn.Linear(dim, dim, bias=False)
        self.out = nn.Linear(dim, dim)
        self.local_skip, self.pooled_skip = nn.Linear(dim, dim, bias=False), nn.Linear(dim, dim, bias=False)
        self.norm = nn.BatchNorm1d(dim)
        nn.init.zeros_(self.out.weight)

    def forward(self, features: Tensor) -> Tensor:
        """[B, N, D] -> [B, N, D]."""
        # A linear map of [local, pooled] is two maps, of which the pooled one is computed once per cloud.
        pooled = features.amax(dim=1, keepdim=True)
        hidden = self.local_in(features.relu()) + self.pooled_in(pooled.relu())
        out = self.local_skip(features) + self.pooled_skip(pooled) + self.out(hidden.relu())
        return self.norm(out.flatten(0, 1)).view_as(out)


class PartLevel(nn.Module):
    """The PointNet that reads aligned clouds and reconstructions alike."""

    def __init__(self, num_parts: int, dim: int, blocks: int) -> None:
        """Args: K; channels; residual blocks."""
        super().__init__()
        self.num_joints = num_parts - 1
        self.lift = nn.Linear(3, dim)
        self.blocks = nn.Sequential(*(_Block(dim) for _ in range(blocks)))
        self.parts = nn.Sequential(nn.Linear(dim, dim), nn.BatchNorm1d(dim), nn.ReLU(), nn.Linear(dim, num_parts))
        self.joints = nn.Sequential(
            nn.Linear(dim, dim), nn.BatchNorm1d(dim), nn.ReLU(), nn.Linear(dim, 8 * self.num_joints)
        )
        # The copies of a joint's two sides begin alike. Those that begin apart are the better and the worse for all
        # points, and the worse part soon has none.
        state = self.joints[-1].weight.view(self.num_joints, 8, dim)[:, 6:], self.joints[-1].bias.view(-1, 8)[:, 6:]
        nn.init.normal_(state[0], std=_START_WEIGHT)
        nn.init.zeros_(state[1])

    def forward(
        self,
        points: Tensor,  # [B, N, 3] canonical space
        state_bound: Tensor,  # [] largest |state| of a side
    ) -> JointGuess:
        """Parts and joints."""
        features = self.blocks(self.lift(points))
        logits = self.parts(features.flatten(0, 1)).view(*points.shape[:2], -1)
        out = self.joints(features.amax(dim=1)).view(len(points), self.num_joints, 8)
        # The sigmoid of the original, centred, is this.
        state = state_bound * (out[..., 6:] / 2).tanh()
        return JointGuess(logits.softmax(dim=-1), out[..., :3], functional.normalize(out[..., 3:6], dim=-1), state)


def side_alignments(
    seen: JointGuess,
    canonical: JointGuess,
    joint_type: int,
) -> Tensor:  # [B, J, 2, 4, 4]
    """Of every joint and each of its sides the motion that brings this side of X' onto Y.

    Turns the seen joint line onto the canonical one, pivot onto pivot, then moves by the difference of the states.
    """
    turn = rotation_between(seen.axis, canonical.axis)
    onto = se3(turn, canonical.pivot - torch.einsum("bjik,bjk->bji", turn, seen.pivot))
    axis, pivot = (x[:, :, None].expand(-1, -1, 2, -1) for x in (canonical.axis, canonical.pivot))
    return screw_motion(axis, pivot, canonical.state - seen.state, joint_type) @ onto[:, :, None]


def part_alignments(
    sides: Tensor,  # [B, J, 2, 4, 4]
) -> Tensor:  # [B, K, 4, 4]
    """Rigid motion of every part onto Y: that of its side, for the shared part 0 the mean over its joints.

    The mean of the rotations is the chordal one, that of the translations the mean of where its pivots' copies of the
    origin go, as in the authors' evaluation.
    """
    shared = sides[:, :, 0].mean(dim=1)
    if sides.shape[1] > 1:
        shared = se3(roma.special_procrustes(shared[..., :3, :3]), shared[..., :3, 3])
    return torch.cat([shared[:, None], sides[:, :, 1]], dim=1)


def part_copies(
    points: Tensor,  # [B, N, 3] X'
    sides: Tensor,  # [B, J, 2, 4, 4]
) -> tuple[Tensor, Tensor]:  # [B, K, N, 3], [B, J, N, 3]
    """Z: a copy of the whole cloud per part; that of the shared part is the mean of its copies, which come second."""
    copies = transform_points(sides, points[:, None, None])
    shared = copies[:, :, 0]
    return torch.cat([shared.mean(dim=1, keepdim=True), copies[:, :, 1]], dim=1), shared


def joint_state(seen: JointGuess, canonical: JointGuess) -> Tensor:
    """State [B, J] of the non-shared part relative to the reconstruction, about the canonical axis."""
    moved = seen.state - canonical.state
    return moved[..., 1] - moved[..., 0]


def object_to_input(rotation: Tensor, translation: Tensor) -> Tensor:
    """Pose [B, 4, 4] of canonical space in the frame of the input, of R [B, 3, 3] and t [B, 3]."""
    return se3(rotation, torch.einsum("bij,bj->bi", rotation, translation))


def aligned(points: Tensor, rotation: Tensor, translation: Tensor) -> Tensor:
    """X' [B, N, 3]."""
    return transform_points(invert_se3(object_to_input(rotation, translation)), points)
