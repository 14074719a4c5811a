"""What the articulated network says about clouds: shapes, structure, and one articulated pose per hypothesis."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.network.heads.shape import CanonicalShape
from articulate_ssl.network.heads.structure import Structure
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.joints import Joints

LINES = ("confidence", "pair_pivot", "pair_axis", "pivot", "axis")  # of a structure, which every cloud has of its own


@dataclass(frozen=True)
class Hypotheses:
    """Of every cloud one shape and structure, and H poses: of the group and all starts of the states, or a selection.

    Attributes:
        shape: Canonical part shapes and their assembly.
        structure: Kinematic chain and joint lines.
        base: [B, H, 4, 4] canonical object space -> camera space.
        state: [B, H, J] radians or displacement relative to the canonical object.
        association_logits: [B, C, K] part proposal at the C backbone centres.
    """

    shape: CanonicalShape
    structure: Structure
    base: Tensor
    state: Tensor
    association_logits: Tensor

    @property
    def part_shape(self) -> Tensor:
        """[B, K, M, 3] canonical part shapes Z_i."""
        return self.shape.part_shape

    @property
    def assembly(self) -> Tensor:
        """[B, K, 3] translations p_i^c into canonical object space."""
        return self.shape.assembly

    @property
    def chain(self) -> KinematicChain:
        """The kinematic chain that poses are built with."""
        return self.structure.chain

    @property
    def axis(self) -> Tensor:
        """[B, H, J, 3] unit, canonical object space."""
        return self.structure.axis

    @property
    def pivot(self) -> Tensor:
        """[B, J, 3] canonical object space."""
        return self.structure.pivot

    def object_shape(self) -> Tensor:
        """Canonical object shape Z = {Z_i + p_i^c}, [B, K, M, 3]."""
        return self.shape.object_shape()

    def articulation(self) -> Tensor:
        """Motion of every part in canonical object space, [B, H, K, 4, 4]."""
        return self.structure.joints().articulation(self.state)

    def object_pose(self) -> Tensor:
        """Canonical object space -> camera space of every part, [B, H, K, 4, 4]."""
        return self.structure.joints().part_pose(self.base, self.state)

    def posed(self, every: int = 1) -> Tensor:
        """Reconstructions Y_i^g, [B, H, K, M, 3]; of a part's points one in `every`."""
        pose, shape = self.object_pose(), self.object_shape()
        shape = shape if every == 1 else shape[:, :, ::every]
        return torch.einsum("bhkij,bkmj->bhkmi", pose[..., :3, :3], shape) + pose[..., None, :3, 3]

    def select(self, index: Tensor) -> Hypotheses:
        """Keep hypotheses `index` [B, H'] of every cloud, or one, [B]."""
        index = index if index.dim() == 2 else index[:, None]
        rows = torch.arange(len(index), device=index.device)[:, None]
        return replace(
            self,
            structure=self.structure.select(rows, index),
            base=self.base[rows, index],
            state=self.state[rows, index],
        )

    def rows(self, index: Tensor) -> Hypotheses:
        """Those of some of the clouds, [n]."""
        lines = {name: getattr(self.structure, name)[index] for name in LINES}
        return replace(
            self,
            shape=CanonicalShape(*(value[index] for value in self.shape)),
            structure=replace(self.structure, **lines),
            base=self.base[index],
            state=self.state[index],
            association_logits=self.association_logits[index],
        )

    def with_rows(self, index: Tensor, other: Hypotheses) -> Hypotheses:
        """The same, but clouds [n] as `other`, which is of these, has them; part proposals stay."""

        def put(own: Tensor, new: Tensor) -> Tensor:
            return own.index_copy(0, index, new.to(own))

        return _merged(self, other, put)

    def at(
        self,
        base: Tensor,  # [B, H, 4, 4]
        state: Tensor,  # [B, H, J]
    ) -> Hypotheses:
        """The same shapes and structure at other poses."""
        return replace(self, base=base, state=state)

    def articulated_shape(self) -> ArticulatedShape:
        """The canonical objects of the B H hypotheses, cloud by cloud, as `registration` takes them."""
        shape, copies = self.object_shape(), self.axis.shape[1]
        num_parts, shape_points = shape.shape[1:3]
        label = torch.arange(num_parts, device=shape.device).repeat_interleave(shape_points)
        points = shape.flatten(1, 2).repeat_interleave(copies, dim=0)
        pivot = self.pivot.repeat_interleave(copies, dim=0)
        return ArticulatedShape(
            points, label, Joints(self.chain, self.axis.flatten(0, 1), pivot, self.structure.joint_type)
        )


def concatenated(several: list[Hypotheses]) -> Hypotheses:
    """Hypotheses of several batches as one; chain and joint type are those of the first."""

    def joined(values: Iterable[Tensor]) -> Tensor:
        return torch.cat(list(values))

    first = several[0]
    lines = {name: joined(getattr(one.structure, name) for one in several) for name in LINES}
    return replace(
        first,
        shape=CanonicalShape(*map(joined, zip(*(one.shape for one in several), strict=True))),
        structure=replace(first.structure, **lines),
        base=joined(one.base for one in several),
        state=joined(one.state for one in several),
        association_logits=joined(one.association_logits for one in several),
    )


def either(
    where: Tensor,  # [B] bool
    one: Hypotheses,
    other: Hypotheses,
) -> Hypotheses:
    """Of every cloud the hypotheses of `one`, or where it says not, of `other`; part proposals are those of `one`."""

    def chosen(first: Tensor, second: Tensor) -> Tensor:
        return torch.where(where.view(-1, *[1] * (first.dim() - 1)), first, second)

    return _merged(one, other, chosen)


def _merged(one: Hypotheses, other: Hypotheses, merge: Callable[[Tensor, Tensor], Tensor]) -> Hypotheses:
    """Shapes, lines and poses of both as `merge` has them; part proposals are those of `one`."""
    lines = {name: merge(getattr(one.structure, name), getattr(other.structure, name)) for name in LINES}
    return replace(
        one,
        shape=CanonicalShape(*map(merge, one.shape, other.shape)),
        structure=replace(one.structure, **lines),
        base=merge(one.base, other.base),
        state=merge(one.state, other.state),
    )
