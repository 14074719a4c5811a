"""Fit a shape with joints to clouds of objects whose proportions differ, by gradient descent.

Registration moves one rigid shape per part. Ovens differ more in width and height than an open door differs from a
closed one, so there every cloud's object also stretches each part; what parts and joints explain then shows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import roma
import torch
from torch import Tensor
from torch.nn import functional

from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.ops.chamfer import nearest_distance, nearest_squared_distance
from articulate_ssl.shape.articulated_shape import MIN_POINTS, ArticulatedShape
from articulate_ssl.shape.joints import Joints
from articulate_ssl.shape.part_maps import PartMaps
from articulate_ssl.shape.stretch import hinged, principal_directions, stretch_matrices

# A distance d counts as d / (1 + d / softness): what the template lacks, and clouds turned over, count little.
_SOFTNESS = 0.05
# Largest log-stretch: a part is at most 1.4 times as long or as short as the template's. Chosen, not tuned, as is the
# network's `stretch_bound` of .3.
_BOUND = 0.35
_START = 0.95  # of the bound: a start beyond is one here, where the gradient still lives
_RIDGE = 1e-3  # weight of the squared log-stretch: decides what the clouds leave open
# Weight of the squared distance that a cloud's own joint lines go from where they started, and where the state of a
# joint is known: with nothing to make up for, a line that is free is placed worse (docs/experiments.md, step 135).
_HELD, _HELD_KNOWN = 0.1, 1.0
# Weight of how far parts are from the line of a joint between them, by the mean of that many nearest points of each.
# They may be as far as in the template, within the bounds of the slack (docs/experiments.md, step 125).
_TOUCH, _NEAREST = 0.3, 8
_SLACK = (0.02, 0.05)
_RATE = 0.01  # of Adam, at the start
_LAST_RATE = 0.02  # what is left of it in the last cycle
_POINTS = 384  # of template and cloud, drawn anew for every step
_CAP = 0.06  # distances beyond this count as this when points are given to parts
_SMOOTHING = 16  # template points over which labels are smoothed
# What turns has to explain a point better than what it is hinged on by so much, where it moves the point by the second
# or farther; by less near its hinge, where nothing explains much better. Chosen on training clouds of ovens, safes and
# laptops (docs/experiments.md, step 273).
_CLEARER, _FAR = 0.006, 0.07


class InstanceFit:
    """Labels and joint lines that n clouds share, and of every cloud its pose, joint states and stretch of each part.

    Parts stretch along the principal axes they have in the template: the root about its centre, any other part about
    the pivot of its joint, which moves with the part it is on (`shape.stretch`). In a frame that clouds have in common,
    where parts slide, they also lie elsewhere: drawers of one chest are lower than those of another.

    Args:
        shape: Points and labels at joint state zero; states stay within the joints' limits if there are any. Joint
            lines [n, J, 3] are each cloud's own: their pivots then move a little even if nothing is shared.
        base: [n, 4, 4] start.
        state: [n, J] start.
        generator: Of the points drawn.
        axes: [K, 3, 3] columns along which parts stretch instead; joint axes then stay as they are.
        faces: [K, 3, 3] columns along which parts stretch instead, and nothing else.
        log_stretch: [n, K, 3] start; none by default.
        bound: Largest log-stretch.
        beside: [n, K, 3] start of where else parts lie, with `axes`; none by default. Along a slide it stays as it is,
            as how far a part has slid says the same.
    """

    def __init__(
        self,
        shape: ArticulatedShape,
        base: Tensor,
        state: Tensor,
        generator: torch.Generator,
        axes: Tensor | None = None,
        log_stretch: Tensor | None = None,
        beside: Tensor | None = None,
        faces: Tensor | None = None,
        bound: float = _BOUND,
    ) -> None:
        self._shape, self._base, self._generator = shape, base, generator
        self._axis, self._pivot, self._state = shape.joints.axis.clone(), shape.joints.pivot.clone(), state.clone()
        self._turn, self._shift = (base.new_zeros(len(base), 3) for _ in range(2))
        self._start = self._pivot.clone() if self._pivot.dim() == 3 else None
        self._held, self._bound = _HELD, bound
        self._stretch, self._beside = (base.new_zeros(len(base), shape.num_parts, 3) for _ in range(2))
        if log_stretch is not None:
            self._stretch += bound * (log_stretch / bound).clamp(-_START, _START).atanh()
        if beside is not None:
            self._beside += beside
        self.axes, given = axes, faces if axes is None else axes
        self._principal = given is None
        self._axes = torch.eye(3).to(base).repeat(shape.num_parts, 1, 1) if given is None else given
        self._children = list(shape.joints.chain.child)
        self._center = shape.points.mean(dim=0)
        self._slack: Tensor | None = None  # [n, 2 J] how far parts may be from the lines of joints that draw them
        self._measure_parts()

    @property
    def shape(self) -> ArticulatedShape:
        """Points, labels and joint lines as they are now."""
        return replace(self._shape, joints=self._joints())

    @property
    def base(self) -> Tensor:
        """[n, 4, 4] canonical object space -> cloud."""
        turn = self._base[:, :3, :3] @ roma.rotvec_to_rotmat(self._turn)
        return se3(turn, self._base[:, :3, 3] + self._shift)

    @property
    def state(self) -> Tensor:
        """[n, J] joint states."""
        return self._state

    @property
    def log_stretch(self) -> Tensor:
        """[n, K, 3] of every part along its principal axes, within the bound."""
        return self._bound * (self._stretch / self._bound).tanh()

    @property
    def beside(self) -> Tensor | None:
        """[n, K, 3] where else parts lie, in template space; None where they may not."""
        return None if self.axes is None else self._beside

    def rehinged(
        self,
        joint: int,
        pivot: Tensor,  # [3]
    ) -> InstanceFit:
        """A copy in which a revolute joint's line goes through another point, and states follow as well as they can."""
        shape, base, state = self.shape, self.base, self.state
        pivots = shape.joints.pivot.clone()
        pivots[joint] = pivot
        moved = replace(shape, joints=replace(shape.joints, pivot=pivots))
        state = moved.read_states(shape.joints.part_pose(base, state))
        other = InstanceFit(moved, base, state, self._generator, self.axes, bound=self._bound)
        other._stretch, other._beside = self._stretch.clone(), self._beside.clone()
        return other

    def optimise(
        self,
        clouds: Tensor,  # [n, N, 3]
        cycles: int,
        steps: int = 6,
        shared: bool = True,
        keep: float = 1.0,
        bidirectional: bool = True,
        touching: bool = False,
        known: tuple[Tensor, Tensor] | None = None,
        owing: bool = False,
    ) -> None:
        """Descend for `cycles` times `steps` steps; with `shared`, also joint lines, and labels after every cycle.

        Args:
            keep: Share of the clouds, best fitted first, that count.
            bidirectional: The clouds show all sides, so that each of the template's points must be near them, too.
            touching: Both parts of a joint are drawn to its line, as by the paper's joint regularization.
            known: [n] bool, whether clouds stay turned as they are, and [n, J] bool, whether joint states stay.
            owing: What turns has what it explains clearly better (`clearer_by`), not what it explains as well.
        """
        own = [self._state, self._turn, self._shift, self._stretch]
        # In a frame that clouds have in common, what slides slides along one of its axes, exactly.
        lines = [self._axis, self._pivot] if self.axes is None else [self._pivot]
        own = own if self.axes is None else [*own, self._beside]
        own = own if self._start is None else [*own, self._pivot]
        parameters = lines + own if shared else own
        template = self._shape.points.expand(len(self._base), -1, -1)
        self._slack = self._to_lines(template, self._joints()).clamp(*_SLACK) if touching else None
        if known is not None:
            self._held = torch.where(known[1], _HELD_KNOWN, _HELD)
        optimizer = torch.optim.Adam([p.requires_grad_() for p in parameters], lr=_RATE)
        for cycle in range(cycles):
            for group in optimizer.param_groups:
                group["lr"] = _RATE * (0.5 + _LAST_RATE + 0.5 * math.cos(math.pi * cycle / cycles))
            for _ in range(steps):
                optimizer.zero_grad()
                with torch.enable_grad():
                    self._loss(clouds, keep, bidirectional).backward()
                if known is not None:
                    self._turn.grad[known[0]] = 0
                    self._state.grad[known[1]] = 0
                if self.axes is not None:
                    self._beside.grad[:, self._children] -= self._along_slides(self._beside.grad[:, self._children])
                optimizer.step()
                self._state.data = self._shape.joints.clamped(self._state.data)
            if shared:
                self._relabel(clouds, keep, owing)
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
        return self.maps().move(self._shape.points[rows], self._shape.label[rows])

    def maps(self) -> PartMaps:
        """Of every part, from the template to each cloud: stretched, then articulated and posed."""
        rest, joints = self._stretched()
        return rest.then(joints.part_pose(self.base, self._state))

    def instances(self) -> ArticulatedShape:
        """The clouds' own shapes [n, T, 3] and joints, in canonical object space at joint states zero."""
        rest, joints = self._stretched()
        return replace(self._shape, points=rest.move(self._shape.points, self._shape.label), joints=joints)

    def _stretched(self) -> tuple[PartMaps, Joints]:
        """From the template to each cloud's own shape, and that shape's joints."""
        joints = self._joints()
        rest, pivots = hinged(stretch_matrices(self._axes, self.log_stretch), self._center, joints)
        if self.axes is not None:
            pivots = pivots + self._beside[:, self._children]
            moved = torch.ones(self._shape.num_parts, 1).to(self._beside)
            moved[joints.chain.root] = 0
            rest = replace(rest, shift=rest.shift + moved * self._beside)
        return rest, replace(joints, pivot=pivots)

    def _along_slides(
        self,
        offset: Tensor,  # [n, J, 3]
    ) -> Tensor:  # [n, J, 3]
        """What of it is along the slides."""
        slide = self._joints().axis
        return (offset * slide).sum(dim=-1, keepdim=True) * slide

    def _joints(self) -> Joints:
        axis = functional.normalize(self._axis, dim=-1)
        return replace(self._shape.joints, axis=axis, pivot=self._pivot)

    def _loss(self, clouds: Tensor, keep: float, bidirectional: bool) -> Tensor:
        rows = self._draw(len(self._shape.label), clouds.device)
        posed, seen = self.posed(rows), clouds[:, self._draw(clouds.shape[1], clouds.device)]
        error = _softened(_distance(seen, posed)).mean(dim=1)
        if bidirectional:
            error = _softened(_distance(posed, seen)).mean(dim=1) + error
        counts = error.detach() <= error.detach().quantile(keep)
        ridge = _RIDGE * (self._stretch.square().sum() + self._beside.square().sum())
        if self._start is not None:
            ridge = ridge + (self._held * (self._pivot - self._start).square().sum(dim=-1)).sum()
        if self._slack is not None:
            ridge = ridge + _TOUCH * self._apart().sum()
        return error[counts].sum() + ridge

    def _apart(self) -> Tensor:
        """How much farther parts are from the lines of their joints than they may be, in all clouds [n]."""
        rest, joints = self._stretched()
        distances = self._to_lines(rest.move(self._shape.points, self._shape.label), joints)
        return (distances - self._slack).relu().sum(dim=-1)

    def _to_lines(self, points: Tensor, joints: Joints) -> Tensor:
        """How far both parts of every joint are from its line [n, 2 J]; wherever they turn, that stays the same."""
        result = []
        for joint, ends in enumerate(zip(joints.chain.parent, joints.chain.child, strict=True)):
            axis, pivot = joints.axis[..., joint, None, :], joints.pivot[..., joint, None, :]
            for part in ends:
                offset = points[:, self._shape.label == part] - pivot
                away = (torch.linalg.cross(offset, axis.expand_as(offset)).square().sum(dim=-1) + 1e-12).sqrt()
                result.append(away.topk(min(_NEAREST, away.shape[1]), largest=False).values.mean(dim=1))
        return torch.stack(result, dim=-1)

    def _draw(self, total: int, device: torch.device) -> Tensor:
        return torch.randperm(total, generator=self._generator)[:_POINTS].to(device)

    def _measure_parts(self) -> None:
        """Centre of the root, and principal axes of every part; a part that lost its points keeps what it had."""
        for part in range(self._shape.num_parts):
            points = self._shape.part(part)
            if len(points) < MIN_POINTS:
                continue
            if self._principal:
                self._axes[part] = principal_directions(points)
            if part == self._shape.joints.chain.root:
                self._center = points.mean(dim=0)

    @torch.no_grad()
    def _relabel(self, clouds: Tensor, keep: float, owing: bool) -> None:
        """Give every template point to the part whose motion brings it closest to the clouds."""
        error = self.error(clouds, queries=256)
        kept = error <= error.quantile(keep)
        maps, points = self.maps(), self._shape.points
        moved = [
            torch.einsum("nij,mj->nmi", maps.linear[kept, part], points) + maps.shift[kept, part, None]
            for part in range(self._shape.num_parts)
        ]
        cost = [nearest_distance(one, clouds[kept]).clamp(max=_CAP).mean(dim=0) for one in moved]
        cost = torch.stack(cost, dim=1)
        cost = cost + clearer_by(moved, self._shape.joints) if owing else cost
        self._shape = replace(self._shape, label=smooth_labels(points, cost))
        self._measure_parts()


def clearer_by(
    moved: Sequence[Tensor],  # K times [n, T, 3]
    joints: Joints,
) -> Tensor:  # [T, K]
    """By how much closer each part must bring points than the root does, to have them.

    Walls across a hinge's axis stay in their plane however they turn: a disk of a body's wall about the hinge is
    explained as well by a door, which then holds it (docs/experiments.md, step 273).

    Nothing of what slides: walls along the slide, which stay in their plane, too, are as often its own.

    Args:
        moved: Points, moved into n clouds as if all were of one part.
    """
    owed = torch.zeros(moved[0].shape[1], len(moved)).to(moved[0])
    if joints.joint_type == REVOLUTE:
        for parent, child in zip(joints.chain.parent, joints.chain.child, strict=True):
            apart = (moved[child] - moved[parent]).norm(dim=-1).mean(dim=0)
            owed[:, child] = owed[:, parent] + _CLEARER * (apart / _FAR).clamp(max=1).square()
    return owed


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
