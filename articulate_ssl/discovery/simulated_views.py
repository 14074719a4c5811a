"""Depth views of registered complete clouds: what a camera would see of them, with poses and states known exactly.

Complete clouds show what one view hides, so parts and joints are found in them far more surely; a network for depth
views is then taught by views of those clouds. Only what a depth camera does is simulated: hidden sides, the density of
its pixels, and that a view is normalised by what it shows, hence in another scale than the complete cloud.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from articulate_ssl.discovery.discover import DiscoveryError
from articulate_ssl.discovery.one_object.surface import Surface
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.discovery.reshaping import Reshaping
from articulate_ssl.geometry.screw import PRISMATIC
from articulate_ssl.ops.hidden_points import seen_from_origin

# Of an object's bounding radius, the distance at which it fills a field of view of 60 degrees, up to 1.3 as far.
DISTANCE = 2.0, 2.6


def simulate_views(
    found: RegisteredShape,  # registered to the clouds
    clouds: Tensor,  # [m, P, 3] complete, farthest-point order
    rotations: Tensor,  # [m, V, 3, 3] canonical object space -> camera (x right, y down, z forward)
    num_points: int,
    mean_distance: float,
    generator: np.random.Generator,
    reshape: bool = False,
    limits: Tensor | None = None,
) -> tuple[Tensor, RegisteredShape]:
    """V views [n, N, 3] of every cloud, in the camera's frame, and the shape registered to them.

    The shape is as large as in views in the mean; how much larger or smaller one view shows it is a stretch of all its
    parts. Views in which fewer than `num_points` points are seen are left out.

    Args:
        num_points: N.
        mean_distance: Of a view's points to their centre, as its pixels count them; views are normalised to it.
        generator: Of the camera's distance, and of proportions.
        reshape: Whether each view is of another object, with other proportions and joint states (`reshaping`).
        limits: [J, 2] between which these states are; None are those that clouds show.

    Raises:
        DiscoveryError: if no view shows so many points.
    """
    points, bases, scales, states, sources, parts = [], [], [], [], [], []
    reshaping, drawn = Reshaping(found, clouds), torch.Generator().manual_seed(int(generator.integers(2**31)))
    base = found.base.double().numpy()
    for rotation in rotations.double().numpy().swapaxes(0, 1):
        objects = reshaping.draw(drawn, limits) if reshape else reshaping.unchanged()
        oriented = zip(objects.points.double().numpy(), objects.normals.double().numpy(), strict=True)
        for i, surface in enumerate(oriented):
            turn = np.eye(4)
            turn[:3, :3] = rotation[i] @ base[i, :3, :3].T
            view = _view(Surface(*surface).moved(turn), mean_distance, generator)
            if len(view.points) < num_points:
                continue
            pose = turn @ base[i]
            pose[:3, 3] = view.scale * (pose[:3, 3] + view.shift)
            points.append(view.points[:num_points])
            parts.append(reshaping.point_part[i][torch.from_numpy(view.seen[:num_points])])
            bases.append(pose)
            scales.append(view.scale)
            states.append(objects.state[i])
            sources.append(i)
    if not points:
        raise DiscoveryError(
            f"no view of the {len(clouds)} scans shows {num_points} points of their {clouds.shape[1]}: take denser "
            "scans, or fewer points (--data.num_points)"
        )
    scale = torch.tensor(scales, dtype=clouds.dtype)
    mean = math.exp(float(scale.log().mean()))
    state, stretch = torch.stack(states), found.log_stretch[sources] + (scale / mean).log()[:, None, None]
    if found.shape.joints.joint_type == PRISMATIC:
        state = state * scale[:, None]
    registered = replace(
        found,
        shape=found.shape.scaled(mean),
        base=torch.from_numpy(np.stack(bases)).to(found.base),
        state=state,
        log_stretch=stretch,
        error=found.error[sources] * scale,
        beside=None if found.beside is None else scale[:, None, None] * found.beside[sources],
        point_part=torch.stack(parts),
        quarters=None if found.quarters is None else found.quarters[sources],
    )
    return torch.from_numpy(np.stack(points)).to(clouds), registered


class _View(NamedTuple):
    points: np.ndarray  # [M, 3] that are seen: scale * (point + shift)
    seen: np.ndarray  # [M] which of the cloud's they are
    scale: float
    shift: np.ndarray  # [3]


def _view(surface: Surface, mean_distance: float, generator: np.random.Generator) -> _View:
    """Of a camera at the origin that looks along z at the middle of the cloud."""
    shift = in_front(surface.points, generator.uniform(*DISTANCE))
    placed = surface.points + shift
    seen = seen_from_origin(placed, surface.normals)
    points, normals = placed[seen], surface.normals[seen]
    distance = np.linalg.norm(points, axis=1)
    pixels = np.abs((normals * points).sum(axis=1)) / distance**3  # of a patch of surface: its solid angle
    center = np.average(points, axis=0, weights=pixels)
    scale = mean_distance / np.average(np.linalg.norm(points - center, axis=1), weights=pixels)
    return _View(scale * (points - center), seen, float(scale), shift - center)


def in_front(
    points: np.ndarray,  # [N, 3]
    distance: float,
) -> np.ndarray:  # [3]
    """What moves an object in front of a camera at the origin, so many of its bounding radii away along z."""
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    radius = np.linalg.norm(points - middle, axis=1).max()
    return np.array([0.0, 0.0, distance * radius]) - middle
