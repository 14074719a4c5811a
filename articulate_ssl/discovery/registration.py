"""Registration of a shape to point clouds by soft correspondences: rigid, part by part, and articulated.

A soft correspondence is a Gaussian responsibility, as in coherent point drift; correspondences are formed in both
directions, so that a shape covers the cloud as well as lying on it. Where clouds do not show all sides of a shape, they
are formed from the cloud to the shape only: nothing pulls at hidden points. Clouds never interact: every function
treats its leading axis as independent problems.
"""

from __future__ import annotations

import roma
import torch
from torch import Tensor

from articulate_ssl.geometry.se3 import se3
from articulate_ssl.ops.denormals import flush_denormals
from articulate_ssl.shape.articulated_shape import MIN_POINTS, ArticulatedShape

_BATCH_ENTRIES = 2**22  # entries of one responsibility matrix

# What turns a part about an axis by so little (a thin rod about its length) is noise: such a rotation stays as it was.
_INERTIA = 0.02
# Weight with which points of the shape hold their place, where nothing else holds them.
_HELD = 1e-4


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
    shape: ArticulatedShape,
    pose: Tensor,  # [n, K, 4, 4]
    clouds: Tensor,  # [n, N, 3]
    scale: float,  # standard deviation of the correspondence kernel
    bidirectional: bool = True,
) -> Tensor:  # [n, K, 4, 4]
    """One round of soft-correspondence registration of every part on its own (weighted Kabsch)."""
    weights, targets = [], []
    for cloud, posed in _batches(clouds, shape.moved(pose)):
        logits = _squared_distances(cloud, posed).mul_(-1 / (2 * scale**2))
        explain = logits.softmax(dim=2)
        weight = explain.sum(dim=1) + (1.0 if bidirectional else _HELD)
        if bidirectional:
            pulled = explain.add_(logits.softmax(dim=1)).transpose(1, 2) @ cloud
        else:
            pulled = explain.transpose(1, 2) @ cloud + _HELD * posed
        weights.append(weight)
        targets.append(pulled / weight[..., None])
    weight, target = torch.cat(weights), torch.cat(targets)
    points = shape.points.expand(len(clouds), -1, 3)
    poses = []
    for part in range(shape.num_parts):
        mine = (shape.label == part).nonzero().squeeze(-1)
        if len(mine) < MIN_POINTS:
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
    whole = ArticulatedShape.rigid(template)
    starts = len(rotations)
    shift = clouds.mean(dim=1)[:, None] - rotations @ template.mean(dim=0)  # [n, H, 3]
    pose = se3(rotations.expand(len(clouds), -1, -1, -1), shift).flatten(0, 1)[:, None]
    copies = clouds.repeat_interleave(starts, dim=0)
    for scale in _annealed(scales, rounds):
        pose = update_poses(whole, pose, copies, scale)
    error = chamfer_l1(copies, whole.moved(pose)).view(-1, starts)
    best = error.topk(min(keep, starts), largest=False)
    rows = torch.arange(len(clouds), device=clouds.device)[:, None]
    return pose.view(-1, starts, 4, 4)[rows, best.indices], best.values


def register_articulated(
    shape: ArticulatedShape,
    clouds: Tensor,  # [n, N, 3]
    base: Tensor,  # [n, 4, 4] start
    state: Tensor,  # [n, J] start
    scales: tuple[float, float],
    rounds: int,
    bidirectional: bool = True,
) -> tuple[Tensor, Tensor, Tensor]:
    """Register an articulated shape without leaving its joints.

    Every round moves each part freely, reads the joint states off the relative motions, and moves the articulated whole
    rigidly onto where the parts went.

    Args:
        bidirectional: The clouds show all sides of the shape, so that each of its points must be near them, too.

    Returns:
        Base poses [n, 4, 4], joint states [n, J], Chamfer-L1 errors [n].
    """
    still = torch.eye(4, dtype=base.dtype, device=base.device).expand_as(base)
    for scale in _annealed(scales, rounds):
        free = update_poses(shape, shape.joints.part_pose(base, state), clouds, scale, bidirectional)
        state = shape.read_states(free)
        base = se3(*roma.rigid_points_registration(shape.posed(still, state), shape.moved(free)))
    return base, state, chamfer_l1(clouds, shape.posed(base, state), bidirectional)


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
