"""Poses, joint states and joint lines of all clouds of one object at once: point to plane, between all clouds.

What bundle adjustment is to photographs. Every point is brought to canonical object space with the part it belongs to,
and pulled onto the plane of its nearest neighbour in a few of the other clouds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import roma
import torch
from torch import Tensor

from articulate_ssl.discovery.one_object.surface import Surface
from articulate_ssl.geometry.se3 import invert_se3, se3
from articulate_ssl.ops.kd_tree import kd_tree
from articulate_ssl.shape.joints import Joints

_PARTNERS = 4  # clouds that each cloud is matched with, others in every matching
_NEIGHBOURS = 4  # candidates among which one with a like normal is looked for
_ALIKE = 0.8  # least cosine between normals; chosen, not tuned
# Of L-BFGS between two matchings. With 12 the axis of one CAD dishwasher, whose thin door says little about its tilt,
# was 5.0 degrees off and .04 nearer with every matching; with 40 it is .7 off, with 100 1.2.
_ITERATIONS = 40
# Normalised units: matches beyond are none, matching by matching.
_FARTHEST = (0.1, 0.06, 0.06, 0.03, 0.03, 0.015, 0.015, 0.015)
_SOFTER = 5.0  # residuals beyond that part of the farthest match count linearly


@dataclass(frozen=True)
class Placed:
    """Joints, and where and how the object is in each of n clouds.

    Attributes:
        joints: In canonical object space.
        base: [n, 4, 4] canonical object space -> cloud.
        state: [n, J].
    """

    joints: Joints
    base: Tensor
    state: Tensor

    @property
    def pose(self) -> Tensor:
        """[n, K, 4, 4] canonical object space -> clouds."""
        return self.joints.part_pose(self.base, self.state)


def adjusted(
    placed: Placed,  # float64
    surfaces: list[Surface],  # n, of as many points each
    label: np.ndarray,  # [n, N]
    iterations: int = _ITERATIONS,
) -> Placed:
    """The same after a few rounds of matching and descent."""
    points = torch.from_numpy(np.stack([s.points for s in surfaces]))
    normals = torch.from_numpy(np.stack([s.normals for s in surfaces]))
    part = torch.from_numpy(label)
    generator = np.random.default_rng(0)
    for farthest in _FARTHEST:
        matches = _matches(placed.pose, points, normals, part, farthest, generator)
        placed = _descended(placed, points, part, *matches, soft=farthest / _SOFTER, iterations=iterations)
    return placed


def _canonical(pose: Tensor, points: Tensor, part: Tensor) -> Tensor:
    """Points [n, N, 3] of clouds in canonical object space."""
    back = invert_se3(pose)[torch.arange(len(points))[:, None], part]  # [n, N, 4, 4]
    return (back[..., :3, :3] @ points[..., None]).squeeze(-1) + back[..., :3, 3]


def _matches(
    pose: Tensor, points: Tensor, normals: Tensor, part: Tensor, farthest: float, generator: np.random.Generator
) -> tuple[Tensor, Tensor, Tensor]:  # [m], [m], [m, 3]
    """Flat indices of points and of their matches, and the matches' normals in canonical object space.

    Each cloud is matched with a few others, one by one. The nearest of all clouds' points would be near by chance, and
    the pull towards it none.
    """
    n, count = points.shape[:2]
    with torch.no_grad():
        flat = _canonical(pose, points, part).numpy()
        turned = torch.zeros_like(pose)
        turned[..., :3, :3], turned[..., 3, 3] = pose[..., :3, :3], 1
        normal = _canonical(turned, normals, part).numpy()
    # Parts far apart in a fourth coordinate, so that one query finds neighbours in the same part only.
    label = part.numpy()
    apart = np.concatenate([flat, 10.0 * label[..., None]], axis=-1)
    trees = [kd_tree(one) for one in apart]
    ones, others = [], []
    for shift in generator.permutation(np.arange(1, n))[:_PARTNERS]:
        for i in range(n):
            j = (i + shift) % n
            distance, index = trees[j].query(apart[i], k=_NEIGHBOURS, distance_upper_bound=farthest)
            index = np.minimum(index, count - 1)  # where there is no neighbour, its distance is infinite
            fits = np.isfinite(distance) & (np.abs(np.einsum("mki,mi->mk", normal[j][index], normal[i])) > _ALIKE)
            some, first = fits.any(axis=1), fits.argmax(axis=1)
            ones.append(i * count + np.flatnonzero(some))
            others.append(j * count + index[some, first[some]])
    one, other = torch.from_numpy(np.concatenate(ones)), torch.from_numpy(np.concatenate(others))
    return one, other, torch.from_numpy(normal).flatten(0, 1)[other]


def _descended(
    placed: Placed,
    points: Tensor,
    part: Tensor,
    one: Tensor,
    other: Tensor,
    normal: Tensor,
    soft: float,
    iterations: int,
) -> Placed:
    free = [torch.zeros_like(v, requires_grad=True) for v in (placed.base[:, 0, :3], placed.base[:, 0, :3])]
    free += [torch.zeros_like(v, requires_grad=True) for v in (placed.state, placed.joints.axis, placed.joints.pivot)]
    optimizer = torch.optim.LBFGS(free, max_iter=iterations, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimizer.zero_grad()
        flat = _canonical(_moved(placed, *free).pose, points, part).flatten(0, 1)
        residual = ((flat[one] - flat[other]) * normal).sum(dim=-1)
        value = torch.nn.functional.huber_loss(residual / soft, torch.zeros_like(residual))
        value.backward()
        return value

    with torch.enable_grad():
        optimizer.step(loss)
    return _moved(placed, *(v.detach() for v in free))


def _moved(placed: Placed, turn: Tensor, shift: Tensor, state: Tensor, axis: Tensor, pivot: Tensor) -> Placed:
    joints = placed.joints
    base = se3(placed.base[:, :3, :3] @ roma.rotvec_to_rotmat(turn), placed.base[:, :3, 3] + shift)
    axis = torch.nn.functional.normalize(joints.axis + axis, dim=-1)
    return Placed(replace(joints, axis=axis, pivot=joints.pivot + pivot), base, placed.state + state)
