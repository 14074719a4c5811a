"""Joint lines moved to where both of their parts are.

Where a line is, reconstruction hardly says: what a part in other states is then displaced by, the pose, stretch and
hinge of each cloud make up for, and a shape that was fused about a wrong line fits with it as well as the right one
does (docs/experiments.md, step 160). But a hinge holds two parts together, so both come near its line, in all joint
states: the paper's joint regularization (`losses.joint_regularization`), here of points of the clouds themselves, and
of all clouds together. A part that was cut too short in the shape is whole in them.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn import functional

from articulate_ssl.geometry.se3 import invert_se3, transform_points
from articulate_ssl.network.hypotheses import Hypotheses
from articulate_ssl.ops.chamfer import nearest_distance

# All in normalised units; chosen on training clouds (docs/experiments.md, step 160).
_REACH, _STEP = 0.2, 0.01  # lines are looked for so far away, on a grid
_NEAREST = 8  # points of a part that say how near it is to a line
_AS_NEAR = 0.003  # where parts are hardly farther from a line, the one that is moved least is taken
# A line stays unless both parts together come nearer by so much: in other objects they are as far. Views show one side
# of a hinge; what came nearer by less there was moved for better or worse (docs/experiments.md, steps 160 and 204).
_WORTH, _WORTH_IN_VIEWS = 0.02, 0.03


def shifts_to_touch(
    one: Hypotheses,  # H = 1, of n clouds, whose joints turn
    clouds: Tensor,  # [n, P, 3] dense
    views: bool = False,
) -> tuple[Tensor, Tensor]:  # [J, 3], [J, 2]
    """How far joint lines are to be moved, in canonical object space, so that both of their parts are near them.

    Which part a point is of, explanations say by which part is nearest.

    Args:
        one: Explanations.
        clouds: What they are of.
        views: Whether clouds are depth views.

    Returns:
        That, 0 where lines stay; and how far the parts of each joint are from its line, together, before and after, in
        the median cloud.
    """
    chain, pose, posed = one.chain, one.object_pose()[:, 0], one.posed()[:, 0]
    part = torch.stack([nearest_distance(clouds, posed[:, k]) for k in range(chain.num_parts)]).argmin(dim=0)
    shifts, apart = clouds.new_zeros(len(chain.child), 3), clouds.new_zeros(len(chain.child), 2)
    for joint, (parent, child) in enumerate(zip(chain.parent, chain.child, strict=True)):
        axis = functional.normalize(one.axis[:, 0, joint].mean(dim=0), dim=0)
        across = torch.linalg.svd(axis[None]).Vh[1:].T  # [3, 2] of the plane that the part turns in
        own = (transform_points(invert_se3(pose[:, parent]), clouds) - one.pivot[:, joint, None]) @ across
        far = _distances(own, part == parent, part == child)
        shift, now, then = _nearest_line(far)
        if now - then > (_WORTH_IN_VIEWS if views else _WORTH):
            shifts[joint] = across @ shift.to(across)
        apart[joint] = clouds.new_tensor([now, then])
    return shifts, apart


def _grid() -> np.ndarray:
    """[G, 2] shifts; that by nothing is in the middle."""
    along = np.arange(-round(_REACH / _STEP), round(_REACH / _STEP) + 1) * _STEP
    return np.stack(np.meshgrid(along, along, indexing="ij"), axis=-1).reshape(-1, 2)


def _distances(points: Tensor, parent: Tensor, child: Tensor) -> np.ndarray:
    """How far both parts together [n', G] are from every line of the grid, in the clouds that show enough of both."""
    grid, found = _grid(), []
    for cloud, one, other in zip(points.cpu().numpy(), parent.cpu().numpy(), child.cpu().numpy(), strict=True):
        if min(one.sum(), other.sum()) >= _NEAREST:
            found.append(
                sum(cKDTree(cloud[own]).query(grid, k=_NEAREST)[0].mean(axis=1) for own in (one, other)),
            )
    return np.stack(found) if found else np.zeros((1, len(grid)))


def _nearest_line(far: np.ndarray) -> tuple[Tensor, float, float]:
    """The shift [2] in the plane, and how far parts are before and after it."""
    grid, far = _grid(), np.median(far, axis=0)
    near = np.flatnonzero(far <= far.min() + _AS_NEAR)
    best = near[np.linalg.norm(grid[near], axis=1).argmin()]
    return torch.from_numpy(grid[best]), float(far[len(grid) // 2]), float(far[best])
