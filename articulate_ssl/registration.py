"""Registration of a labelled template to point clouds by soft correspondences: rigid, part by part, and articulated.

A soft correspondence is a Gaussian responsibility, as in coherent point drift; correspondences are formed in both
directions, so that a template covers the cloud as well as lying on it. Clouds never interact: every function treats its
leading axis as independent problems.
"""

from __future__ import annotations

from dataclasses import dataclass

import roma
import torch
from torch import Tensor

from articulate_ssl.kinematic_chain import KinematicChain
from articulate_ssl.ops.denormals import flush_denormals
from datamodules.geometry import REVOLUTE, invert_se3, screw_motion, se3, transform_points

_BATCH_ENTRIES = 2**22  # entries of one responsibility matrix

# What turns a part about an axis by so little (a thin rod about its length) is noise: such a rotation stays as it was.
_INERTIA = 0.02

# Of each stage of a search: points, correspondence scales, rounds, survivors.
_HALVING = (
    (96, (0.14, 0.08), 3, 24),
    (128, (0.08, 0.04), 4, 12),
    (256, (0.05, 0.03), 4, 12),
)
_SAME = 0.5  # radians: orientations closer than this are one hypothesis


@dataclass(frozen=True)
class LabelledTemplate:
    """Template points with the part each belongs to.

    Attributes:
        points: [T, 3] canonical object space, or [n, T, 3] where every cloud has its own shape.
        label: [T] int64.
        num_parts: K.
    """

    points: Tensor
    label: Tensor
    num_parts: int

    def thinned(self, num_points: int) -> LabelledTemplate:
        """About `num_points` points, the same share of every part and at least 4 of each."""
        share = num_points / len(self.label)
        if share >= 1:
            return self
        rows = []
        for part in range(self.num_parts):
            mine = (self.label == part).nonzero().squeeze(-1)
            count = min(len(mine), max(4, round(share * len(mine))))
            rows.append(mine[torch.linspace(0, len(mine) - 1, count).round().long()])
        rows = torch.cat(rows).sort().values
        return LabelledTemplate(self.points[..., rows, :], self.label[rows], self.num_parts)

    def posed(self, pose: Tensor) -> Tensor:
        """Points moved with their part, pose [n, K, 4, 4] -> [n, T, 3]."""
        pose = pose[:, self.label]
        return (pose[..., :3, :3] @ self.points[..., None]).squeeze(-1) + pose[..., :3, 3]


@dataclass(frozen=True)
class JointModel:
    """A category's joints in canonical object space.

    Attributes:
        chain: Kinematic chain.
        axis: [J, 3] unit, or [n, J, 3].
        pivot: [J, 3] or [n, J, 3].
        joint_type: `REVOLUTE` or `PRISMATIC`.
        limits: [J, 2] lowest and highest joint state, or None.
    """

    chain: KinematicChain
    axis: Tensor
    pivot: Tensor
    joint_type: int
    limits: Tensor | None = None

    def articulation(self, state: Tensor) -> Tensor:
        """Part motions [n, K, 4, 4] in canonical object space at joint states [n, J]."""
        shape = (*state.shape, 3)
        return self.chain.part_motion(
            screw_motion(self.axis.expand(shape), self.pivot.expand(shape), state, self.joint_type)
        )

    def part_pose(self, base: Tensor, state: Tensor) -> Tensor:
        """Part poses [n, K, 4, 4] of base poses [n, 4, 4] and joint states [n, J]."""
        return base[:, None] @ self.articulation(state)

    def read_states(self, template: LabelledTemplate, pose: Tensor) -> Tensor:
        """Joint states [n, J] that fit freely estimated part poses [n, K, 4, 4] best."""
        states = []
        for j, (parent, child) in enumerate(zip(self.chain.parent, self.chain.child, strict=True)):
            rest = template.points[..., template.label == child, :]  # [(n,) m, 3]
            moved = transform_points(invert_se3(pose[:, parent]) @ pose[:, child], rest)
            axis, pivot = self.axis[..., j, None, :], self.pivot[..., j, None, :]
            if self.joint_type == REVOLUTE:
                # The angle about the joint line that brings the part's points closest to where they were moved.
                radius, moved = rest - pivot, moved - pivot
                side = torch.linalg.cross(axis.expand_as(radius), radius)
                flat = radius - (radius * axis).sum(dim=-1, keepdim=True) * axis
                states.append(torch.atan2((side * moved).sum(dim=(-2, -1)), (flat * moved).sum(dim=(-2, -1))))
            else:
                states.append(((moved - rest).mean(dim=-2) * axis.squeeze(-2)).sum(dim=-1))
        state = torch.stack(states, dim=-1)
        return state if self.limits is None else state.clamp(*self.limits.unbind(-1))


def chamfer_l1(
    clouds: Tensor,  # [n, N, 3]
    posed: Tensor,  # [n, T, 3]
    bidirectional: bool = True,
) -> Tensor:  # [n]
    """Mean nearest distance of the clouds to the shapes, plus with `bidirectional` that of the shapes to the clouds."""
    errors = []
    for cloud, shape in _batches(clouds, posed):
        distance = torch.cdist(cloud, shape)
        error = distance.amin(dim=2).mean(dim=1)
        errors.append(error + distance.amin(dim=1).mean(dim=1) if bidirectional else error)
    return torch.cat(errors)


@flush_denormals()
def update_poses(
    template: LabelledTemplate,
    pose: Tensor,  # [n, K, 4, 4]
    clouds: Tensor,  # [n, N, 3]
    scale: float,  # standard deviation of the correspondence kernel
) -> Tensor:  # [n, K, 4, 4]
    """One round of soft-correspondence registration of every part on its own (weighted Kabsch)."""
    weights, targets = [], []
    for cloud, posed in _batches(clouds, template.posed(pose)):
        logits = _squared_distances(cloud, posed).mul_(-1 / (2 * scale**2))
        explain, attract = logits.softmax(dim=2), logits.softmax(dim=1)
        weight = explain.sum(dim=1) + 1.0
        weights.append(weight)
        targets.append((explain.add_(attract).transpose(1, 2) @ cloud) / weight[..., None])
    weight, target = torch.cat(weights), torch.cat(targets)
    points = template.points.expand(len(clouds), -1, 3)
    poses = []
    for part in range(template.num_parts):
        mine = (template.label == part).nonzero().squeeze(-1)
        if len(mine) < 4:
            poses.append(pose[:, part])
            continue
        poses.append(_register(points[:, mine], target[:, mine], weight[:, mine], pose[:, part, :3, :3]))
    return torch.stack(poses, dim=1)


def register_rigid(
    template: Tensor,  # [T, 3]
    clouds: Tensor,  # [n, N, 3]
    rotations: Tensor,  # [H, 3, 3] starts, about the centres
    keep: int,
    scales: tuple[float, float] = (0.15, 0.05),
    rounds: int = 8,
) -> tuple[Tensor, Tensor]:
    """The `keep` best rigid registrations of a template to every cloud over all rotation starts.

    Returns:
        Poses [n, keep, 4, 4] template -> cloud, best first, and their Chamfer-L1 errors [n, keep].
    """
    whole = LabelledTemplate(template, torch.zeros(len(template), dtype=torch.long, device=template.device), 1)
    starts = len(rotations)
    shift = clouds.mean(dim=1)[:, None] - rotations @ template.mean(dim=0)  # [n, H, 3]
    pose = se3(rotations.expand(len(clouds), -1, -1, -1), shift).flatten(0, 1)[:, None]
    copies = clouds.repeat_interleave(starts, dim=0)
    for scale in _annealed(scales, rounds):
        pose = update_poses(whole, pose, copies, scale)
    error = chamfer_l1(copies, whole.posed(pose)).view(-1, starts)
    best = error.topk(min(keep, starts), largest=False)
    rows = torch.arange(len(clouds), device=clouds.device)[:, None]
    return pose.view(-1, starts, 4, 4)[rows, best.indices], best.values


def register_articulated(
    template: LabelledTemplate,
    joints: JointModel,
    clouds: Tensor,  # [n, N, 3]
    base: Tensor,  # [n, 4, 4] start
    state: Tensor,  # [n, J] start
    scales: tuple[float, float],
    rounds: int,
    bidirectional: bool = True,
) -> tuple[Tensor, Tensor, Tensor]:
    """Register an articulated template without leaving its joints.

    Every round moves each part freely, reads the joint states off the relative motions, and moves the articulated whole
    rigidly onto where the parts went.

    Returns:
        Base poses [n, 4, 4], joint states [n, J], Chamfer-L1 errors [n].
    """
    still = torch.eye(4, dtype=base.dtype, device=base.device).expand_as(base)
    for scale in _annealed(scales, rounds):
        free = update_poses(template, joints.part_pose(base, state), clouds, scale)
        state = joints.read_states(template, free)
        shape = template.posed(joints.part_pose(still, state))
        base = se3(*roma.rigid_points_registration(shape, template.posed(free)))
    return base, state, chamfer_l1(clouds, template.posed(joints.part_pose(base, state)), bidirectional)


def search_articulated(
    template: LabelledTemplate,
    joints: JointModel,
    clouds: Tensor,  # [n, N, 3], farthest-point order
    rotations: Tensor,  # [H, 3, 3] starts, about the centres
    states: Tensor,  # [Q, J] joint states to start from
) -> tuple[Tensor, Tensor, Tensor]:
    """The best, different articulated registrations of every cloud over all orientations and joint states.

    Successive halving: all starts get a few rounds on few points, the better ones, if they differ, some more. All
    points order the last: what tells a laptop's lid from its base is finer than the spacing of the few points that
    suffice to register it.

    Returns:
        Base poses [n, C, 4, 4], joint states [n, C, J], Chamfer-L1 errors [n, C], best first.
    """
    still = torch.eye(4).to(clouds).expand(len(states), 4, 4)
    shapes = template.posed(joints.part_pose(still, states))  # [Q, T, 3]
    shift = clouds.mean(dim=1)[:, None, None] - torch.einsum("hij,qj->hqi", rotations, shapes.mean(dim=1))
    base = se3(rotations[None, :, None].expand(len(clouds), -1, len(states), -1, -1), shift).flatten(1, 2)
    state = states.repeat(len(rotations), 1).expand(len(clouds), -1, -1)
    rows = torch.arange(len(clouds), device=clouds.device)[:, None]
    for num_points, scales, rounds, survivors in _HALVING:
        count = base.shape[1]
        copies = clouds[:, :num_points].repeat_interleave(count, dim=0)
        flat = register_articulated(
            template.thinned(num_points), joints, copies, base.flatten(0, 1), state.flatten(0, 1), scales, rounds
        )
        base, state, error = (value.unflatten(0, (len(clouds), count)) for value in flat)
        best = _different(base, error, min(survivors, count))
        base, state, error = base[rows, best], state[rows, best], error[rows, best]
    posed = template.posed(joints.part_pose(base.flatten(0, 1), state.flatten(0, 1)))
    error = chamfer_l1(clouds.repeat_interleave(base.shape[1], dim=0), posed).unflatten(0, (len(clouds), -1))
    order = error.argsort(dim=1)
    return base[rows, order], state[rows, order], error[rows, order]


def _different(base: Tensor, error: Tensor, count: int) -> Tensor:
    """Indices [n, count] of the best hypotheses, passing over those turned like a better one while others are left."""
    rows = torch.arange(len(base), device=base.device)
    left, chosen = error.clone(), []
    for _ in range(count):
        best = left.argmin(dim=1)
        chosen.append(best)
        angle = roma.rotmat_geodesic_distance(base[..., :3, :3], base[rows, best, None, :3, :3])
        left = (left + 1e3 * (angle < _SAME)).scatter(1, best[:, None], torch.inf)
    return torch.stack(chosen, dim=1)


def _register(source: Tensor, target: Tensor, weight: Tensor, before: Tensor) -> Tensor:
    """Weighted Kabsch [n, 4, 4], as if the source were `_INERTIA` thicker and the extra had moved with `before`."""
    weight = (weight / weight.sum(dim=-1, keepdim=True))[..., None]
    source_mean, target_mean = (weight * source).sum(dim=1), (weight * target).sum(dim=1)
    source_offset = source - source_mean[:, None]
    covariance = (weight * (target - target_mean[:, None])).transpose(1, 2) @ source_offset
    # Soft targets are drawn together; the extra must be as much.
    size = (weight * source_offset).transpose(1, 2) @ source_offset
    shrinkage = covariance.norm(dim=(1, 2)) / size.norm(dim=(1, 2)).clamp(min=1e-12)
    rotation = roma.special_procrustes(covariance + (_INERTIA**2 * shrinkage)[:, None, None] * before)
    return se3(rotation, target_mean - (rotation @ source_mean[..., None]).squeeze(-1))


def _squared_distances(cloud: Tensor, posed: Tensor) -> Tensor:
    """[n, N, T] by one product; half the time of `torch.cdist`, and exact enough for Gaussian responsibilities."""
    square = torch.baddbmm(posed.square().sum(dim=-1)[:, None], cloud, posed.transpose(1, 2), alpha=-2)
    return square.add_(cloud.square().sum(dim=-1)[..., None])


def _annealed(scales: tuple[float, float], rounds: int) -> list[float]:
    return torch.logspace(*torch.tensor(scales).log10(), rounds).tolist()


def _batches(clouds: Tensor, posed: Tensor):
    rows = max(1, _BATCH_ENTRIES // (clouds.shape[1] * posed.shape[1]))
    return zip(clouds.split(rows), posed.split(rows), strict=True)
