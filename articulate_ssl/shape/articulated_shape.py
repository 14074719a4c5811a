"""The one model of an articulated object: labelled points with joints, posed by a base pose and joint states."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from articulate_ssl.geometry.se3 import invert_se3, transform_points
from articulate_ssl.shape.joints import Joints, stacked
from articulate_ssl.shape.part_maps import PartMaps

MIN_POINTS = 4  # of a part: fewer do not determine how it is turned


@dataclass(frozen=True)
class ArticulatedShape:
    """Points in canonical object space, the part each belongs to, and the joints of the parts.

    What registration moves, what the instance fit stretches, what discovery hands over and what the network's
    hypotheses are registered as.

    Attributes:
        points: [T, 3] canonical object space at joint states zero, or [n, T, 3] where every cloud has its own shape.
        label: [T] int64 part indices, 0..K-1.
        joints: Of the K parts; none while only the parts are known.
    """

    points: Tensor
    label: Tensor
    joints: Joints

    @staticmethod
    def unjointed(points: Tensor, label: Tensor, num_parts: int) -> ArticulatedShape:
        """Parts that no joint connects."""
        return ArticulatedShape(points, label, Joints.none(num_parts, points))

    @staticmethod
    def rigid(points: Tensor) -> ArticulatedShape:
        """One part."""
        label = torch.zeros(points.shape[-2], dtype=torch.long, device=points.device)
        return ArticulatedShape.unjointed(points, label, 1)

    @property
    def num_parts(self) -> int:
        """K."""
        return self.joints.chain.num_parts

    @property
    def smallest_share(self) -> float:
        """Share of the points that the smallest part has."""
        counts = torch.bincount(self.label, minlength=self.num_parts)
        return float(counts.min() / counts.sum())

    def part(self, part: int) -> Tensor:
        """Points [..., m, 3] of one part."""
        return self.points[..., self.label == part, :]

    def thinned(self, num_points: int) -> ArticulatedShape:
        """About `num_points` points, the same share of every part and at least `MIN_POINTS` of each."""
        share = num_points / len(self.label)
        if share >= 1:
            return self
        rows = []
        for part in range(self.num_parts):
            mine = (self.label == part).nonzero().squeeze(-1)
            count = min(len(mine), max(MIN_POINTS, round(share * len(mine))))
            rows.append(mine[torch.linspace(0, len(mine) - 1, count).round().long()])
        rows = torch.cat(rows).sort().values
        return replace(self, points=self.points[..., rows, :], label=self.label[rows])

    def moved(
        self,
        part_pose: Tensor,  # [n, K, 4, 4] of every part, whether joints allow it or not
    ) -> Tensor:  # [n, T, 3]
        """Points moved with their part."""
        return PartMaps.of(part_pose).move(self.points, self.label)

    def posed(
        self,
        base: Tensor,  # [n, 4, 4] canonical object space -> camera space
        state: Tensor,  # [n, J]
    ) -> Tensor:  # [n, T, 3]
        """Points in camera space at joint states."""
        return self.moved(self.joints.part_pose(base, state))

    def read_states(
        self,
        part_pose: Tensor,  # [n, K, 4, 4] freely estimated
    ) -> Tensor:  # [n, J]
        """The joint states, within the limits, that fit the part poses best."""
        joints, states = self.joints, []
        for j, (parent, child) in enumerate(zip(joints.chain.parent, joints.chain.child, strict=True)):
            rest = self.part(child)  # [(n,) m, 3]
            moved = transform_points(invert_se3(part_pose[:, parent]) @ part_pose[:, child], rest)
            axis, pivot = joints.axis[..., j, None, :], joints.pivot[..., j, None, :]
            if joints.joint_type == REVOLUTE:
                # The angle about the joint line that brings the part's points closest to where they were moved.
                radius, moved = rest - pivot, moved - pivot
                side = torch.linalg.cross(axis.expand_as(radius), radius)
                flat = radius - (radius * axis).sum(dim=-1, keepdim=True) * axis
                states.append(torch.atan2((side * moved).sum(dim=(-2, -1)), (flat * moved).sum(dim=(-2, -1))))
            else:
                states.append(((moved - rest).mean(dim=-2) * axis.squeeze(-2)).sum(dim=-1))
        return joints.clamped(stacked(states, part_pose))

    def in_frame(
        self,
        frame: Tensor,  # [4, 4] canonical object space -> another
    ) -> ArticulatedShape:
        """The same shape in another canonical object space."""
        points = transform_points(frame, self.points)
        axis = self.joints.axis @ frame[:3, :3].T
        pivot = transform_points(frame, self.joints.pivot)
        return replace(self, points=points, joints=replace(self.joints, axis=axis, pivot=pivot))

    def scaled(self, factor: float) -> ArticulatedShape:
        """The same shape, larger; what slides slides as much farther."""
        joints = replace(self.joints, pivot=factor * self.joints.pivot)
        if joints.limits is not None and joints.joint_type == PRISMATIC:
            joints = replace(joints, limits=factor * joints.limits)
        return replace(self, points=factor * self.points, joints=joints)

    def with_centred_pivots(self) -> ArticulatedShape:
        """Where a pivot sits along its axis is a convention: next to the middle of the part it moves."""
        joints = self.joints
        center = torch.stack([self.part(child).mean(dim=0) for child in joints.chain.child])
        along = ((center - joints.pivot) * joints.axis).sum(dim=1, keepdim=True)
        return replace(self, joints=replace(joints, pivot=joints.pivot + along * joints.axis))
