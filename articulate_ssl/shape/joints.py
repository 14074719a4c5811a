"""Joints in canonical object space: what moves which part, about or along which line, and how far."""

from __future__ import annotations

from dataclasses import dataclass, replace

import roma
import torch
from torch import Tensor

from articulate_ssl.geometry.kinematic_chain import KinematicChain, extract_chain, pair_index
from articulate_ssl.geometry.screw import REVOLUTE, screw_motion


@dataclass(frozen=True)
class Joints:
    """A kinematic chain with the lines of its joints. Leading dimensions (of clouds, of hypotheses) broadcast.

    Attributes:
        chain: Kinematic chain of K parts and J joints.
        axis: [..., J, 3] unit, canonical object space.
        pivot: [..., J, 3] a point on each joint line, canonical object space.
        joint_type: `REVOLUTE` or `PRISMATIC`, of all joints.
        limits: [J, 2] lowest and highest joint state, or None.
    """

    chain: KinematicChain
    axis: Tensor
    pivot: Tensor
    joint_type: int
    limits: Tensor | None = None

    @staticmethod
    def none(num_parts: int, like: Tensor) -> Joints:
        """K parts that no joint connects."""
        nothing = like.new_zeros(0, 3)
        return Joints(KinematicChain(num_parts, 0, (), ()), nothing, nothing, REVOLUTE)

    def articulation(
        self,
        state: Tensor,  # [..., J]
    ) -> Tensor:  # [..., K, 4, 4]
        """Part motions in canonical object space (paper, "Kinematic chain": cascaded articulation)."""
        shape = (*state.shape, 3)
        return self.chain.part_motion(
            screw_motion(self.axis.expand(shape), self.pivot.expand(shape), state, self.joint_type)
        )

    def part_pose(
        self,
        base: Tensor,  # [..., 4, 4] canonical object space -> camera space
        state: Tensor,  # [..., J]
    ) -> Tensor:  # [..., K, 4, 4]
        """Canonical object space -> camera space of every part."""
        return base[..., None, :, :] @ self.articulation(state)

    def with_lines_moved(
        self,
        shift: Tensor,  # [J, 3]
        state: Tensor,  # [J] radians
    ) -> tuple[Joints, Tensor]:  # , [K, 3]
        """Joints that turn about lines elsewhere, and by how much parts are displaced with them.

        Displaced so in canonical object space, all parts are at `state` where they were before.
        """
        displaced = shift.new_zeros(self.chain.num_parts, 3)
        pivot = self.pivot.clone()
        for j, (parent, child) in enumerate(zip(self.chain.parent, self.chain.child, strict=True)):
            back = roma.rotvec_to_rotmat(-state[j] * self.axis[j])
            pivot[j] += shift[j] + displaced[parent]
            displaced[child] = displaced[parent] + shift[j] - back @ shift[j]
        return replace(self, pivot=pivot), displaced

    def clamped(
        self,
        state: Tensor,  # [..., J]
    ) -> Tensor:
        """States within the limits, if there are any."""
        return state if self.limits is None else state.clamp(*self.limits.unbind(-1))


def pair_of_joints(chain: KinematicChain) -> list[int]:
    """For every joint the row of `pair_index` that names the two parts it connects."""
    index = {tuple(pair): e for e, pair in enumerate(pair_index(chain.num_parts).tolist())}
    return [index[min(p, c), max(p, c)] for p, c in zip(chain.parent, chain.child, strict=True)]


def category_chain(chain: KinematicChain) -> KinematicChain:
    """The tree that a category makes of the same pairs of parts (`extract_chain`): its root and order may be others."""
    joined = torch.zeros(len(pair_index(chain.num_parts)))
    joined[pair_of_joints(chain)] = 1
    return extract_chain(joined, chain.num_parts)


def stacked(values: list[Tensor], like: Tensor) -> Tensor:
    """One value per joint [n] as states [n, J]; there may be no joint."""
    return torch.stack(values, dim=-1) if values else like.new_zeros(len(like), 0)
