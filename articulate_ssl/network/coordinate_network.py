"""Which part points are of, and where in it (NPCS, Li et al. 2020): what `SurfaceNetwork` sees in a frame, and heads.

With labels it is the network of NPCS (`baselines.npcs`); without, fits teach it (`inference.pose_network`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import roma
import torch
from torch import Tensor, nn
from torch.nn import functional

from articulate_ssl.geometry.se3 import se3, transform_points
from articulate_ssl.network.surface_network import SurfaceCloud, SurfaceNetwork, SurfaceSize, layer
from articulate_ssl.shape.part_poses import joint_states

_START_WEIGHT = 1e-2


class WholeShape(NamedTuple):
    """What the network says about clouds seen in some frame, before it looks at single points.

    Attributes:
        rotation: [B, K, 3, 3] part space -> the frame.
        shift: [B, K, 3] what to add to points in a part's axes to have them about the part's centre.
        center: [B, K, 3] part centres in the object's rest-state frame.
        axis: [B, J, 3] unit, in the axes of part spaces.
        pivot: [B, J, 3] on the joint line at rest, about the parent's centre.
        local: [B, M', C] features of the points that are left.
        whole: [B, D].
    """

    rotation: Tensor
    shift: Tensor
    center: Tensor
    axis: Tensor
    pivot: Tensor
    local: Tensor
    whole: Tensor

    def rows(self, key) -> WholeShape:
        """Some of the clouds."""
        return WholeShape(*(x[key] for x in self))

    def placed(
        self,
        pose: Tensor,  # [B, K, 4, 4] part space -> camera space
        parent: Sequence[int],  # J parts
        child: Sequence[int],  # J parts
        joint_type: int,
    ) -> dict[str, Tensor]:
        """Object and joints, if parts are there: fields of `Prediction`; states are relative to rest."""
        root = next(part for part in range(pose.shape[1]) if part not in child)
        place, still = pose[:, parent], torch.eye(3).to(pose)
        return {
            "part_pose": pose,
            "assembly": self.center,
            "base_pose": pose[:, root] @ se3(still, -self.center[:, root]),
            "joint_axis": (place[..., :3, :3] @ self.axis[..., None]).squeeze(-1),
            "joint_pivot": transform_points(place, self.pivot[..., None, :]).squeeze(-2),
            "joint_state": joint_states(pose, self.center, self.axis, parent, child, joint_type),
            "canonical_axis": self.axis,
            "canonical_pivot": self.pivot + self.center[:, parent],
        }


class CoordinateNetwork(SurfaceNetwork):
    """Whole-shape features, and heads for poses, joints, parts and coordinates."""

    def __init__(self, num_parts: int, size: SurfaceSize) -> None:
        """Args: K; sizes."""
        super().__init__(size)
        self.num_parts = num_parts
        first, last, dim = size.dims[0], size.dims[-1], size.head_dim
        self.pose = nn.Linear(dim, 9 * num_parts)
        self.structure = nn.Linear(dim, 3 * num_parts + 6 * (num_parts - 1))
        self.point = nn.Sequential(*layer(first + last + 3 + dim, dim), *layer(dim, dim))
        self.part_and_coordinates = nn.Linear(dim, 4 * num_parts)
        # A new network says that parts are turned as the frame is, and corrects nothing.
        for head in (self.pose, self.part_and_coordinates):
            nn.init.normal_(head.weight, std=_START_WEIGHT)
            nn.init.zeros_(head.bias)

    def look(self, seen: SurfaceCloud) -> WholeShape:
        """Of whole clouds as they are seen in some frame."""
        local, whole = self.describe(seen)
        K = self.num_parts
        pose = self.pose(whole).unflatten(-1, (K, 9))
        columns = pose[..., :6].unflatten(-1, (3, 2)) + torch.eye(3, 2, dtype=pose.dtype, device=pose.device)
        center, axis, pivot = self.structure_of(whole)
        return WholeShape(roma.special_gramschmidt(columns), pose[..., 6:], center, axis, pivot, local, whole)

    def structure_of(
        self,
        whole: Tensor,  # [B, D]
    ) -> tuple[Tensor, Tensor, Tensor]:  # [B, K, 3], [B, J, 3], [B, J, 3]
        """Part centres, axes and pivots as `WholeShape` has them, by features of whole clouds."""
        said, last = self.structure(whole).unflatten(-1, (-1, 3)), self.num_parts - 1
        center, axis, pivot = said.split([self.num_parts, last, last], dim=-2)
        return center, functional.normalize(axis, dim=-1), pivot

    def coordinates(self, seen: SurfaceCloud, said: WholeShape) -> tuple[Tensor, Tensor]:  # [B, N, K], [B, K, N, 3]
        """Part logits of all points, and their coordinates in every part's space.

        Points in the axes of a part are its coordinates up to a shift, so that a perceptron need not learn to multiply
        by rotations: it corrects what the whole shape says.
        """
        B, N, _ = seen.points.shape
        # One layer of local features, coordinates, and those of the whole, each applied where there are few of them.
        first, *deeper = self.point
        local, place, whole = first.weight.split([said.local.shape[-1], 3, said.whole.shape[-1]], dim=1)
        hidden = seen.carried(functional.linear(said.local, local)) + functional.linear(seen.points, place)
        hidden = hidden + functional.linear(said.whole, whole, first.bias)[:, None]
        out = self.part_and_coordinates(nn.Sequential(*deeper)(hidden))
        logits, correction = out.split([self.num_parts, 3 * self.num_parts], dim=-1)
        turned = torch.einsum("bni,bkij->bknj", seen.points, said.rotation)
        return logits, turned + said.shift[:, :, None] + correction.view(B, N, -1, 3).transpose(1, 2)
