"""Clouds of simple articulated objects with known parts, poses and joints, in farthest-point-like random order."""

from __future__ import annotations

from typing import NamedTuple

import roma
import torch
from torch import Tensor

from articulate_ssl.geometry.kinematic_chain import KinematicChain, forward_kinematics
from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE, screw_motion
from articulate_ssl.geometry.se3 import se3, transform_points
from articulate_ssl.network.heads.shape import CanonicalShape
from articulate_ssl.network.heads.structure import Structure
from articulate_ssl.network.hypotheses import Hypotheses
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.joints import Joints


class Clouds(NamedTuple):
    """n clouds of an object: points [n, N, 3] of parts [N], base poses [n, 4, 4], states [n, J], joints [J, 3]."""

    points: Tensor
    rest: Tensor  # [N, 3]
    part: Tensor
    base: Tensor
    state: Tensor
    axis: Tensor
    pivot: Tensor


# Corners of each part's box, parent of each part but the first, axis and pivot of its joint, range of its state.
LAPTOP = (
    [((0, 0, 0), (0.6, 0.7, 0.05)), ((0, 0, 0.06), (0.5, 0.7, 0.08))],
    (0,),
    [((0, 1, 0), (0, 0, 0.06))],
    [(-1.6, -0.3)],
    REVOLUTE,
)
DRAWER = (
    [((0, 0, 0), (0.4, 0.6, 0.5)), ((0.05, 0.05, 0.1), (0.42, 0.55, 0.25))],
    (0,),
    [((1, 0, 0), (0, 0, 0))],
    [(0.05, 0.4)],
    PRISMATIC,
)
# A floor with two drawers of different height above its front half, which slide along x.
CHEST = (
    [((-0.4, 0, 0), (0.4, 0.6, 0.02)), ((0.02, 0.05, 0.1), (0.41, 0.55, 0.2)), ((0.02, 0.05, 0.25), (0.41, 0.55, 0.5))],
    (0, 0),
    [((1, 0, 0), (0, 0, 0)), ((1, 0, 0), (0, 0, 0))],
    [(-0.15, 0.15), (-0.15, 0.15)],
    PRISMATIC,
)
OVEN = (
    [((0, 0, 0), (0.5, 0.6, 0.5)), ((0.5, 0, 0.05), (0.54, 0.6, 0.4))],
    (0,),
    [((0, 1, 0), (0.5, 0, 0.05))],
    [(0.4, 1.6)],
    REVOLUTE,
)
GLASSES = (
    [
        ((0, -0.35, 0), (0.04, 0.35, 0.2)),
        ((0.04, 0.31, 0.12), (0.55, 0.35, 0.18)),
        ((0.04, -0.35, 0.12), (0.55, -0.31, 0.18)),
    ],
    (0, 0),
    [((0, 0, 1), (0.04, 0.33, 0.15)), ((0, 0, -1), (0.04, -0.33, 0.15))],
    [(-1.3, 0.0), (-1.3, 0.0)],
    REVOLUTE,
)


def chest_of_height(height: float, limit: float = 0.3):
    """A floor with two drawers above it, of which the lower one ends at that height."""
    return (
        [((0, 0, 0), (0.6, 0.6, 0.02)), ((0, 0, 0.05), (0.6, 0.6, height)), ((0, 0, height + 0.03), (0.6, 0.6, 0.6))],
        (0, 0),
        [((1, 0, 0), (0, 0, 0)), ((1, 0, 0), (0, 0, 0))],
        [(0, limit), (0, limit)],
        PRISMATIC,
    )


def clouds(
    design=LAPTOP,
    count: int = 6,
    points: int = 128,
    resample: bool = False,
    rotate: bool = True,
    seed: int = 0,
    proportions: float = 0.0,
) -> Clouds:
    """Clouds of one object at random states and orientations; `resample` draws other surface points for each.

    With `proportions`, every cloud shows an object of its own, longer or shorter along each axis by up to this factor.
    """
    generator = torch.Generator().manual_seed(seed)
    boxes, parents, joints, ranges, joint_type = design
    K = len(boxes)
    low, high = (torch.tensor([box[i] for box in boxes]).float() for i in (0, 1))
    part = torch.arange(points) % K

    def surface() -> Tensor:
        inside = torch.rand(points, 3, generator=generator)
        area = (high - low).roll(1, dims=1) * (high - low).roll(2, dims=1)  # of the faces across each axis
        across = torch.multinomial(area, points, replacement=True, generator=generator)[part, torch.arange(points)]
        inside[torch.arange(points), across] = (inside[torch.arange(points), across] > 0.5).float()
        return low[part] + inside * (high - low)[part]

    axis, pivot = (torch.tensor([joint[i] for joint in joints]).float() for i in (0, 1))
    lower, upper = torch.tensor(ranges).T
    state = lower + (upper - lower) * torch.rand(count, len(joints), generator=generator)
    rotation = torch.eye(3).repeat(count, 1, 1)
    if rotate:
        rotation = roma.unitquat_to_rotmat(roma.quat_normalize(torch.randn(count, 4, generator=generator)))
    rest = surface()
    size = torch.ones(count, 1, 3)
    if proportions:
        size = (proportions * (2 * torch.rand(count, 1, 3, generator=generator) - 1)).exp()
    motion = forward_kinematics(
        screw_motion(axis.expand(count, -1, 3), size * pivot, state, joint_type),
        parents,
        range(1, K),
        K,
    )
    shapes = torch.stack([surface() if resample else rest for _ in range(count)])
    posed = transform_points(motion[:, part], (size * shapes)[:, :, None])[:, :, 0]
    center = posed.mean(dim=1)
    base = se3(rotation, -(rotation @ center[..., None]).squeeze(-1))
    return Clouds(transform_points(base, posed), rest, part, base, state, axis, pivot)


def true_shape(design, data: Clouds) -> ArticulatedShape:
    """The object of the clouds: points, parts and joints at rest."""
    K = len(design[0])
    chain = KinematicChain(K, 0, design[1], tuple(range(1, K)))
    return ArticulatedShape(data.rest, data.part, Joints(chain, data.axis, data.pivot, design[4]))


def true_hypotheses(design, data: Clouds) -> Hypotheses:
    """The truth of every cloud as an explanation, H = 1, with every sixth point of each part."""
    count, shape = len(data.base), true_shape(design, data)
    parts = torch.stack(
        [shape.part(part)[: len(shape.label) // shape.num_parts : 6] for part in range(shape.num_parts)]
    )
    center = parts.mean(dim=1)
    joints, nothing = shape.joints, torch.zeros(count, len(data.axis))
    pivot, axis = joints.pivot.expand(count, -1, -1), joints.axis.expand(count, 1, -1, -1)
    return Hypotheses(
        CanonicalShape(*(x.expand(count, *x.shape) for x in (parts - center[:, None], center))),
        Structure(nothing, pivot, axis, pivot, axis, joints.chain, joints.joint_type),
        data.base[:, None],
        data.state[:, None],
        torch.zeros(count, 0, shape.num_parts),
    )
