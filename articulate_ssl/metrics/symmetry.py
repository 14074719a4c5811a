"""Rotations that leave a test object as it is, measured from its labelled clouds, and rotation errors modulo them.

The set of an instance's symmetries is measured, as for the objects of the BOP challenge (Hodan et al. 2020), and not
stated per category. A rotation S of the rest-state object frame is a symmetry of an articulated object if

1. it maps every part's surface onto the same part's surface: parts keep their labels, a mirror image is no rotation;
2. it maps every joint's line onto itself, in either direction. A closed laptop without keys looks the same after half a
   turn about the vertical, but its hinge is then in front: no pose of the turned object shows the open one. With this
   rule S belongs to the object in every state, S^-1 motion(q) S = motion(+-q), whichever state is called rest.

If the true poses of all parts are R_k, those that no cloud can tell from them are R_k S, one S for the whole object.

Candidates are the 24 rotations of the cube in the object's axes, so continuous symmetries count by quarter turns.
Rule 1 compares two disjoint halves A and B of the part's pooled rest points, thinned to one point per cell of
`GRID_EDGE`. Let d(S) be the nearest distances between A and S B, in both directions. S counts if the mean of d(S) and
the mean of its farthest hundredth are at most `TOLERANCE` times those of d(identity), which resampling alone makes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.geometry.se3 import invert_se3, transform_points
from articulate_ssl.metrics.functional import axis_angle_error, point_to_line_distance, rotation_error
from articulate_ssl.ops.kd_tree import kd_tree

# Lengths are in units of the object's diagonal.
GRID_EDGE = 0.01  # 5,000 points on a typical part: a tenth of a second per instance
SAME_POINT = 1e-4  # clouds of one instance may share points, which would make resampling look better than it is
POOL_POINTS = 2**16  # four times what the grid keeps of a box
TAIL = 0.01  # a handle is a hundredth of the surface: it hardly changes the mean distance, but it fills this tail
# Simulated symmetric boxes with 700 kept points or more stay below 1.08 in mean and tail, with 150 points (a knob)
# below 1.21. On a box of 16,000 points, a handle on 0.5 % of the surface that stands off by 0.05 has a tail of 1.34, on
# 1 % of 1.6; standing off by 0.02 it has 1.05 and is not seen.
TOLERANCE = 1.25
# Coarser clouds hide handles: at 0.037 the one on 1 % had 1.1. Four clouds of 4096 points have 0.02, one alone 0.037.
COARSEST_TAIL = 0.03
LINE_DISTANCE = 0.02  # two grid cells; chosen without a measurement, as labels are exact
LINE_ANGLE = math.radians(5.0)


@dataclass(frozen=True)
class RestObject:
    """Labelled clouds of one object, every part moved back to rest.

    Frame: rest-state object frame. Unit: any one for all fields; the object's own diagonal is the measure.

    Attributes:
        points: [P, 3] of all parts.
        part_id: [P] part of each.
        part_center: [K, 3] rest-state bounding-box centres.
        joint_axis: [J, 3] unit.
        joint_pivot: [J, 3] a point of each joint's line.
        joint_type: [J] 0 revolute, 1 prismatic.
    """

    points: Tensor
    part_id: Tensor
    part_center: Tensor
    joint_axis: Tensor
    joint_pivot: Tensor
    joint_type: Tensor


def rest_clouds(labels: dict[str, Tensor]) -> dict[str, Tensor]:
    """The labelled dense points, centres and joints of every cloud at rest, in the unit that `scale` is in.

    Clouds of one object that were scaled by what each view shows thereby get one common unit.

    Args:
        labels: shard arrays of B clouds.

    Returns:
        `points` [B, P, 3], `part_id` [B, P], `part_center` [B, K, 3], `joint_axis` and `joint_pivot` [B, J, 3], in the
        rest-state object frame; float32.
    """
    part_id = labels["dense_part_id"].long()
    clouds = torch.arange(len(part_id), device=part_id.device)[:, None]
    to_rest = invert_se3(labels["part_pose"].double())
    scale = labels["scale"].double()[:, None, None]
    points = transform_points(to_rest[clouds, part_id], labels["dense_points"].double()[:, :, None]).squeeze(2)
    of_parent = to_rest[clouds, labels["joint_parent"].long()]  # [B, J, 4, 4]
    axis = (of_parent[..., :3, :3] @ labels["joint_axis"].double()[..., None]).squeeze(-1)
    pivot = transform_points(of_parent, labels["joint_pivot"].double()[:, :, None]).squeeze(2)
    return {
        "points": (points * scale).float(),
        "part_id": part_id.to(torch.uint8),
        "part_center": (labels["part_center"].double() * scale).float(),
        "joint_axis": axis.float(),
        "joint_pivot": (pivot * scale).float(),
    }


def pool(
    clouds: dict[str, Tensor],  # of `rest_clouds`, B clouds of one object
    joint_type: Tensor,  # [J]
) -> RestObject:
    """Several clouds of one object as one; of very many points an even share of all."""
    points, part_id = clouds["points"].double().cpu().flatten(0, 1), clouds["part_id"].long().cpu().flatten()
    step = math.ceil(len(points) / POOL_POINTS)
    center, axis, pivot = (clouds[n][0].double().cpu() for n in ("part_center", "joint_axis", "joint_pivot"))
    return RestObject(points[::step], part_id[::step], center, axis, pivot, joint_type.cpu())


def measured_symmetries(rest: RestObject) -> Tensor:  # [S, 3, 3] float64
    """Every rotation of the cube that is a symmetry of the object by the module's two rules; the identity comes first.

    Only the identity is granted where a part's clouds are too coarse to tell (`COARSEST_TAIL`). Deterministic.
    """
    candidates = rotation_group(24).elements
    diagonal = float((rest.points.amax(0) - rest.points.amin(0)).norm())
    # What labels alone refuse is not measured: most instances are done after this.
    allowed = _keeps_centers(candidates, rest, diagonal) & _keeps_joints(candidates, rest, diagonal)
    for part, center in enumerate(rest.part_center):
        if allowed[1:].any():
            own = (rest.points[rest.part_id == part] - center) / diagonal
            allowed &= _keeps_surface(candidates, own.numpy(), allowed)
    allowed[0] = True
    return candidates[allowed]


def symmetric_rotation_error(
    relative: Tensor,  # [B, K, 3, 3] R_true^T R_predicted of every part
    symmetries: Tensor,  # [S, 3, 3]
) -> Tensor:  # [B, K] radians
    """Rotation errors against R_true S, for the one S of each cloud that leaves the least mean error of its parts."""
    error = rotation_error(relative[:, None], symmetries.to(relative)[None, :, None])  # [B, S, K]
    best = error.mean(-1).argmin(-1)
    return error[torch.arange(len(error), device=error.device), best]


def _keeps_centers(candidates: Tensor, rest: RestObject, diagonal: float) -> Tensor:
    """[24] whether all parts may turn about their own centres and stay together.

    A rotation of the cube maps boxes with the object's axes to such boxes, so a symmetry leaves every part's centre
    where it is; then the centre of any part lies on its axis, and it does not matter about which of them it turns.
    """
    offset = rest.part_center - rest.part_center[:1]
    moved = (offset @ candidates.transpose(-1, -2) - offset).norm(dim=-1)  # [24, K]
    return (moved <= LINE_DISTANCE * diagonal).all(-1)


def _keeps_joints(candidates: Tensor, rest: RestObject, diagonal: float) -> Tensor:
    """[24] whether every joint's line stays where it is; of prismatic joints only the direction counts."""
    turn = candidates.transpose(-1, -2)
    axis, pivot = rest.joint_axis[None], (rest.joint_pivot - rest.part_center[:1])[None]
    parallel = axis_angle_error(axis @ turn, axis) <= LINE_ANGLE  # [24, J]
    near = point_to_line_distance(pivot @ turn, axis, pivot) <= LINE_DISTANCE * diagonal
    return (parallel & (near | (rest.joint_type != REVOLUTE))).all(-1)


def _keeps_surface(
    candidates: Tensor,  # [24, 3, 3], the identity first
    points: np.ndarray,  # [P, 3] of one part about its centre, unit: the object's diagonal
    wanted: Tensor,  # [24] bool: the others are refused without a look
) -> Tensor:  # [24] bool
    """Whether each candidate maps the part onto itself as well as resampling does."""
    points = np.random.default_rng(0).permutation(points)
    distinct = _thin(points, SAME_POINT)
    first, second = _thin(distinct[::2], GRID_EDGE), _thin(distinct[1::2], GRID_EDGE)
    kept = torch.zeros(len(candidates), dtype=torch.bool)
    if len(second) == 0:
        return kept
    trees = kd_tree(first), kd_tree(second)

    def distances(rotation: np.ndarray) -> np.ndarray:  # mean, and mean of the tail
        there, back = trees[1].query(first @ rotation)[0], trees[0].query(second @ rotation.T)[0]
        d = np.sort(np.concatenate([there, back]))
        return np.array([d.mean(), d[-math.ceil(TAIL * len(d)) :].mean()])

    limit = TOLERANCE * distances(np.eye(3))
    if limit[1] > TOLERANCE * COARSEST_TAIL:
        return kept
    for index in wanted.nonzero()[:, 0].tolist():
        kept[index] = bool((distances(candidates[index].numpy()) <= limit).all())
    return kept


def _thin(points: np.ndarray, edge: float) -> np.ndarray:
    """The first point in every cell of a grid, in the order of the points."""
    cell = np.floor(points / edge).astype(np.int64) @ np.array([1, 1 << 20, 1 << 40])
    return points[np.sort(np.unique(cell, return_index=True)[1])]
