"""Fit a labelled template with joints to clouds of objects whose proportions differ, by gradient descent.

Registration moves one rigid shape per part. Ovens differ more in width and height than an open door differs from a
closed one, so there every cloud's object also stretches each part; what parts and joints explain then shows.
"""

from __future__ import annotations

import math
from dataclasses import replace

import roma
import torch
from torch import Tensor
from torch.nn import functional

from articulate_ssl.ops.chamfer import nearest_distance, nearest_squared_distance
from articulate_ssl.registration import JointModel, LabelledTemplate
from datamodules.geometry import se3

# A distance d counts as d / (1 + d / softness): what the template lacks, and clouds turned over, count little.
_SOFTNESS = 0.05
_BOUND = 0.35  # largest log-stretch
_RIDGE = 1e-3  # weight of the squared log-stretch
_RATE = 0.01  # of Adam, at the start
_POINTS = 384  # of template and cloud, drawn anew for every step
_CAP = 0.06  # distances beyond this count as this when points are given to parts
_SMOOTHING = 16  # template points over which labels are smoothed


class InstanceFit:
    """Labels and joint lines that n clouds share, and of every cloud its pose, joint states and stretch of each part.

    Parts stretch along the principal axes they have in the template: the root about its centre, any other part about
    the pivot of its joint, which moves with the part it is on.

    Args:
        template: Points and labels at joint state zero.
        joints: Chain, axes, pivots; states stay within the limits if it has any.
        base: [n, 4, 4] start.
        state: [n, J] start.
        generator: Of the points drawn.
    """

    def __init__(
        self, template: LabelledTemplate, joints: JointModel, base: Tensor, state: Tensor, generator: torch.Generator
    ) -> None:
        self.template, self.joints, self._base, self._generator = template, joints, base, generator
        self._axis, self._pivot, self._state = joints.axis.clone(), joints.pivot.clone(), state.clone()
        self._turn, self._shift = (base.new_zeros(len(base), 3) for _ in range(2))
        self._stretch = base.new_zeros(len(base), template.num_parts, 3)
        self._axes = torch.eye(3).to(base).repeat(template.num_parts, 1, 1)
        self._center = template.points.mean(dim=0)
        self._measure_parts()

    def model(self) -> tuple[JointModel, Tensor, Tensor]:
        """Joints, base poses [n, 4, 4] and states [n, J] as they are now."""
        axis = functional.normalize(self._axis, dim=-1)
        turn = self._base[:, :3, :3] @ roma.rotvec_to_rotmat(self._turn)
        base = se3(turn, self._base[:, :3, 3] + self._shift)
        return replace(self.joints, axis=axis, pivot=self._pivot), base, self._state

    def rehinged(
        self,
        joint: int,
        pivot: Tensor,  # [3]
    ) -> InstanceFit:
        """A copy in which a revolute joint's line goes through another point, and states follow as well as they can."""
        joints, base, state = self.model()
        pivots = joints.pivot.clone()
        pivots[joint] = pivot
        moved = replace(joints, pivot=pivots)
        state = moved.read_states(self.template, joints.part_pose(base, state))
        other = InstanceFit(self.template, moved, base, state, self._generator)
        other._stretch = self._stretch.clone()
        return other

    def optimise(
        self,
        clouds: Tensor,  # [n, N, 3]
        cycles: int,
        steps: int = 6,
        shared: bool = True,
        keep: float = 1.0,
    ) -> None:
        """Descend for `cycles` times `steps` steps; with `shared`, also joint lines, and labels after every cycle.

        Args:
            keep: Share of the clouds, best fitted first, that count.
        """
        own = [self._state, self._turn, self._shift, self._stretch]
        parameters = [self._axis, self._pivot, *own] if shared else own
        optimizer = torch.optim.Adam([p.requires_grad_() for p in parameters], lr=_RATE)
        for cycle in range(cycles):
            for group in optimizer.param_groups:
                group["lr"] = _RATE * (0.52 + 0.5 * math.cos(math.pi * cycle / cycles))
            for _ in range(steps):
                optimizer.zero_grad()
                with torch.enable_grad():
                    self._loss(clouds, keep).backward()
                optimizer.step()
                if self.joints.limits is not None:
                    self._state.data.clamp_(*self.joints.limits.unbind(-1))
            if shared:
                self._relabel(clouds, keep)
        for parameter in parameters:
            parameter.requires_grad_(False)

    @torch.no_grad()
    def error(
        self,
        clouds: Tensor,  # [n, N, 3]
        queries: int = 512,
        softened: bool = True,
    ) -> Tensor:  # [n]
        """Distance in both directions, `queries` points of either against all points of the other.

        Points spaced s apart lie about s / 2 from those of another sample of the same surface. With all of them as
        targets that is little next to what a part in the wrong place costs.
        """
        posed = self.posed()
        rows = torch.linspace(0, posed.shape[1] - 1, min(queries, posed.shape[1])).long()
        forward, backward = nearest_distance(clouds[:, :queries], posed), nearest_distance(posed[:, rows], clouds)
        return sum(_softened(d).mean(dim=1) if softened else d.mean(dim=1) for d in (forward, backward))

    def posed(self, rows: Tensor | slice = slice(None)) -> Tensor:
        """[n, T, 3] the template's points in every cloud."""
        linear, shift = self._maps()
        label = self.template.label[rows]
        # The gradient of index_select sums in a fixed order, that of indexing does not.
        linear, shift = linear.index_select(1, label), shift.index_select(1, label)
        return torch.einsum("nmij,mj->nmi", linear, self.template.points[rows]) + shift

    def _loss(self, clouds: Tensor, keep: float) -> Tensor:
        rows = self._draw(len(self.template.label), clouds.device)
        posed, seen = self.posed(rows), clouds[:, self._draw(clouds.shape[1], clouds.device)]
        error = _softened(_distance(posed, seen)).mean(dim=1) + _softened(_distance(seen, posed)).mean(dim=1)
        counts = error.detach() <= error.detach().quantile(keep)
        return error[counts].sum() + _RIDGE * self._stretch.square().sum()

    def _draw(self, total: int, device: torch.device) -> Tensor:
        return torch.randperm(total, generator=self._generator)[:_POINTS].to(device)

    def _maps(self) -> tuple[Tensor, Tensor]:
        """Of every part, the affine map from the template to each cloud: [n, K, 3, 3] and [n, K, 3]."""
        scale = (_BOUND * (self._stretch / _BOUND).tanh()).exp()
        stretch = (self._axes * scale[..., None, :]) @ self._axes.transpose(-1, -2)
        chain = self.joints.chain
        shift = {chain.root: self._center - torch.einsum("nij,j->ni", stretch[:, chain.root], self._center)}
        pivots = []
        for pivot, parent, child in zip(self._pivot, chain.parent, chain.child, strict=True):
            pivots.append(torch.einsum("nij,j->ni", stretch[:, parent], pivot) + shift[parent])
            shift[child] = pivots[-1] - torch.einsum("nij,j->ni", stretch[:, child], pivot)
        joints, base, state = self.model()
        # A template of one part has no joints.
        moved = torch.stack(pivots, dim=1) if pivots else base.new_zeros(len(base), 0, 3)
        pose = replace(joints, pivot=moved).part_pose(base, state)
        rotation = pose[..., :3, :3]
        rest = torch.stack([shift[part] for part in range(self.template.num_parts)], dim=1)
        return rotation @ stretch, (rotation @ rest[..., None]).squeeze(-1) + pose[..., :3, 3]

    def _measure_parts(self) -> None:
        """Centre of the root, and principal axes of every part; a part that lost its points keeps what it had."""
        for part in range(self.template.num_parts):
            points = self.template.points[self.template.label == part]
            if len(points) < 4:
                continue
            center = points.mean(dim=0)
            self._axes[part] = torch.linalg.eigh((points - center).T @ (points - center)).eigenvectors
            if part == self.joints.chain.root:
                self._center = center

    @torch.no_grad()
    def _relabel(self, clouds: Tensor, keep: float) -> None:
        """Give every template point to the part whose motion brings it closest to the clouds."""
        error = self.error(clouds, queries=256)
        kept = error <= error.quantile(keep)
        linear, shift = self._maps()
        points, cost = self.template.points, []
        for part in range(self.template.num_parts):
            moved = torch.einsum("nij,mj->nmi", linear[kept, part], points) + shift[kept, part, None]
            cost.append(nearest_distance(moved, clouds[kept]).clamp(max=_CAP).sum(dim=0))
        self.template = replace(self.template, label=smooth_labels(points, torch.stack(cost, dim=1)))
        self._measure_parts()


def smooth_labels(
    points: Tensor,  # [T, 3]
    cost: Tensor,  # [T, K]
) -> Tensor:  # [T]
    """The cheapest part of every point and its neighbours together."""
    near = torch.cdist(points, points).topk(min(_SMOOTHING, len(points)), largest=False).indices
    return cost[near].mean(dim=1).argmin(dim=-1)


def _distance(query: Tensor, target: Tensor) -> Tensor:
    """Of every query point to its nearest target point."""
    return (nearest_squared_distance(query, target) + 1e-12).sqrt()


def _softened(distance: Tensor) -> Tensor:
    return distance / (1 + distance / _SOFTNESS)
