"""The category's canonical object: what its instances have in common, as parameters that heads add to."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from articulate_ssl.geometry.kinematic_chain import KinematicChain, extract_chain, pair_index
from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.ops.farthest_point import farthest_point_order
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.joints import Joints, category_chain, pair_of_joints
from articulate_ssl.shape.stretch import principal_directions

_START_SIZE = 0.2  # standard deviation of a part's points before anything is learnt; objects have diagonal 1
# Parts that start apart: distance of each from the middle, and standard deviations of its points away from the joint,
# across the plane of the part, and along the axis. A hinge with flaps; chosen, and the first try worked.
_START_APART, _START_FLAP = 0.12, (0.1, 0.05, 0.18)
# Adjacency confidence of a joint that discovery found, beside 0 of all other pairs: seven to one in a spanning tree.
_FOUND = 2.0


class CanonicalObject(NamedTuple):
    """The category's shapes and joint lines, with gradient, in canonical object space."""

    shape: Tensor  # [K, M, 3]
    axis: Tensor  # [E, 3] unit, of all part pairs
    pivot: Tensor  # [E, 3]


class CategoryObject(nn.Module):
    """Category-level part shapes, their assembly, joint lines and adjacency.

    Attributes:
        template: [K, M, 3] canonical part shapes, each about its own origin.
        assembly: [K, 3] assembling translations.
        axis: [E, 3] and pivot: [E, 3] joint lines of all part pairs.
        confidence: [E] adjacency of the part pairs.
        pairs: [E, 2] the part pairs.
        principal_axes: [K, 3, 3] columns along which instances stretch a part.
        mean_confidence: [E] running mean of the predicted adjacency confidences, from which the chain is extracted.
    """

    def __init__(self, num_parts: int, shape_points: int, shared_axis: bool = False) -> None:
        """Args: K and M; whether all joints have the direction of the chain's first."""
        super().__init__()
        self.shared_axis = shared_axis
        pairs = pair_index(num_parts)
        self.template = nn.Parameter(_START_SIZE * torch.randn(num_parts, shape_points, 3))
        self.assembly = nn.Parameter(torch.zeros(num_parts, 3))
        self.axis = nn.Parameter(functional.normalize(torch.randn(len(pairs), 3), dim=-1))
        self.pivot = nn.Parameter(torch.zeros(len(pairs), 3))
        self.confidence = nn.Parameter(torch.zeros(len(pairs)))
        self.register_buffer("pairs", pairs, persistent=False)
        self.register_buffer("principal_axes", torch.eye(3).repeat(num_parts, 1, 1))
        self.register_buffer("mean_confidence", torch.zeros(len(pairs)))

    @property
    def num_parts(self) -> int:
        """K."""
        return self.template.shape[0]

    def canonical(self) -> CanonicalObject:
        """Shapes and joint lines in canonical object space."""
        shape = self.template + self.assembly[:, None]
        return CanonicalObject(shape, functional.normalize(self.axis, dim=-1), self.pivot)

    def chain(self) -> KinematicChain:
        """The category's kinematic chain, from the running mean of the predicted adjacency confidences."""
        return extract_chain(self.mean_confidence, self.num_parts)

    def joint_axis(self) -> Tensor:
        """[J, 3] unit directions of the chain's joints.

        Where all joints have one, networks read that of the first, and nothing holds those of the others.
        """
        axis = functional.normalize(self.axis[pair_of_joints(self.chain())], dim=-1)
        return axis[:1].expand_as(axis) if self.shared_axis else axis

    @torch.no_grad()
    def articulated_shape(self, joint_type: int) -> ArticulatedShape:
        """The category's own shape with the joints of its chain; what `adopt` took over comes back, but thinned."""
        canonical, chain = self.canonical(), self.chain()
        label = torch.arange(self.num_parts, device=self.template.device).repeat_interleave(self.template.shape[1])
        pair = pair_of_joints(chain)
        return ArticulatedShape(
            canonical.shape.flatten(0, 1), label, Joints(chain, self.joint_axis(), canonical.pivot[pair], joint_type)
        )

    @torch.no_grad()
    def start_apart(self) -> None:
        """Let parts start as flaps around the z axis, joints between them along it.

        Parts that start in one place stay there: no joint state moves one against another, and each becomes the whole
        object. Which part is which, and where the axis is, is free, because poses are.
        """
        scale = self.template.new_tensor(_START_FLAP) / _START_SIZE
        self.template.mul_(scale)
        turn = math.pi * (1 + 2 * torch.arange(self.num_parts, device=scale.device) / self.num_parts)
        place = torch.stack([turn.cos(), turn.sin(), torch.zeros_like(turn)], dim=-1)
        self.assembly.copy_(_START_APART * place)
        self.pivot.copy_(self.assembly[self.pairs].mean(dim=1))
        upward = functional.normalize(0.1 * self.axis + self.axis.new_tensor([0.0, 0.0, 1.0]), dim=-1)
        self.axis.copy_(upward)

    @torch.no_grad()
    def follow(self, confidence: Tensor, weight: float) -> None:
        """Draw the running mean to the confidences [B, E] of a batch."""
        self.mean_confidence.lerp_(confidence.mean(dim=0), weight)

    @torch.no_grad()
    def move_lines(
        self,
        shift: Tensor,  # [J, 3]
        state: Tensor,  # [J] radians
    ) -> None:
        """Let joints turn about lines elsewhere; at `state` all parts stay where they are."""
        joints = self.articulated_shape(REVOLUTE).joints
        moved, displaced = joints.with_lines_moved(shift, state)
        self.pivot[pair_of_joints(joints.chain)] = moved.pivot
        self.assembly += displaced

    @torch.no_grad()
    def turn_lines(
        self,
        axis: Tensor,  # [J, 3] unit
    ) -> None:
        """Let joints turn about these directions, through the same points."""
        self.axis[pair_of_joints(self.chain())] = axis.to(self.axis)

    @torch.no_grad()
    def adopt(self, shape: ArticulatedShape) -> None:
        """Take over a discovered shape and its joints.

        Raises:
            ValueError: if its tree hangs otherwise than this category's would, by which poses and states are told.
        """
        if (tree := category_chain(shape.joints.chain)) != shape.joints.chain:
            raise ValueError(f"the tree is {shape.joints.chain}, the category's would be {tree}: rename its parts")
        shape_points = self.template.shape[1]
        for part in range(self.num_parts):
            points = shape.part(part).cpu().numpy()
            order = farthest_point_order(points, min(len(points), shape_points))
            thinned = torch.as_tensor(np.resize(points[order], (shape_points, 3)))
            center = thinned.mean(dim=0)
            self.assembly[part] = center
            self.template[part] = thinned - center
            self.principal_axes[part] = principal_directions(thinned)
        self.confidence.zero_()
        for j, pair in enumerate(pair_of_joints(shape.joints.chain)):
            self.axis[pair] = shape.joints.axis[j]
            self.pivot[pair] = shape.joints.pivot[j]
            self.confidence[pair] = _FOUND
        self.mean_confidence.copy_(self.confidence)
