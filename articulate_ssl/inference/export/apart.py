"""Parts that move side by side are kept apart.

The drawers of a chest never meet: a plane along the direction in which they slide is between any two of them. Nor do
the doors of a fridge-freezer: a plane across their hinges is. Points that were taken for the wrong part lie beyond it,
and one such point makes the hulls of two parts, which is what simulators collide, block each other. So every part is
cut off at these planes, and a little before them.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
import trimesh

from articulate_ssl.inference.export.hollow import closed_difference

PARALLEL = np.cos(np.deg2rad(5))  # found axes of parts that move one way differ by a degree or less
DIRECTIONS = 90  # that are tried across the axis: every two degrees
# Of the points of either part that may lie beyond the plane; more, and one moves within the other. A third of a
# drawer's points were wrong on the worst twin (IoU .68).
MOST_BEYOND = 0.3
LEAST_KEPT = 0.25  # of a part's points: less tells no shape. Chosen without a measurement, as is the next
CLEARANCE = 0.002  # between two parts, half of it on either side; of the larger one's extent


class Motion(NamedTuple):
    """How a part moves on another.

    Attributes:
        parent: Number of the part that stays.
        child: Number of the part that moves.
        axis: [3] unit, along which it slides or about which it turns.
        turns: Which of the two.
    """

    parent: int
    child: int
    axis: np.ndarray
    turns: bool


class HalfSpace(NamedTuple):
    """The points x with normal . x <= offset.

    Attributes:
        normal: [3] unit.
        offset: Along it.
    """

    normal: np.ndarray
    offset: float

    def holds(
        self,
        points: np.ndarray,  # [N, 3]
    ) -> np.ndarray:  # [N] bool
        """Which points are in it."""
        return points @ self.normal <= self.offset


def half_spaces(
    points: Sequence[np.ndarray],  # K of [M, 3], in one space while all states are zero
    motions: Sequence[Motion],
) -> list[list[HalfSpace]]:
    """Where each part must stay, so that those that move side by side on one part, in one way, never meet."""
    found: list[list[HalfSpace]] = [[] for _ in points]
    for a, b in combinations(motions, 2):
        if a.parent != b.parent or a.turns != b.turns or abs(a.axis @ b.axis) < PARALLEL:
            continue
        # Only along such normals does what moves never come nearer to the plane.
        normals = np.stack([a.axis, -a.axis]) if a.turns else _across(a.axis)
        plane = _plane_between(points[a.child], points[b.child], normals)
        if plane is not None:
            clearance = CLEARANCE / 2 * max(np.ptp(points[part], axis=0).max() for part in (a.child, b.child))
            found[a.child].append(plane._replace(offset=plane.offset - clearance))
            found[b.child].append(HalfSpace(-plane.normal, -plane.offset - clearance))
    return found


def kept(
    points: np.ndarray,  # [M, 3]
    spaces: Sequence[HalfSpace],
) -> np.ndarray:  # [m, 3]
    """The points that are in all of them; all points where that is hardly any, as of two plates face to face."""
    inside = np.all([np.ones(len(points), dtype=bool), *(space.holds(points) for space in spaces)], axis=0)
    return points[inside] if inside.mean() >= LEAST_KEPT else points


def _across(axis: np.ndarray) -> np.ndarray:
    """Directions [D, 3] at right angles to an axis [3], all the way round."""
    across = np.linalg.svd(axis[None])[2][1:]  # [2, 3]
    angle = 2 * np.pi * np.arange(2 * DIRECTIONS) / (2 * DIRECTIONS)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1) @ across


def _plane_between(
    points: np.ndarray,  # [M, 3]
    others: np.ndarray,  # [M', 3]
    normals: np.ndarray,  # [D, 3] unit
) -> HalfSpace | None:
    """The plane with the fewest points beyond it, `points` below; None if too many are."""
    best, wrong, margin = None, MOST_BEYOND, 0.0
    for normal in normals:
        place = np.concatenate([points @ normal, others @ normal])
        order = np.argsort(place)
        below = np.concatenate([np.full(len(points), 1 / len(points)), np.zeros(len(others))])[order].cumsum()
        above = np.concatenate([np.zeros(len(points)), np.full(len(others), 1 / len(others))])[order].cumsum()
        beyond = np.maximum(1 - below, above)[:-1]  # of a plane behind each point
        place = place[order]
        gap = np.diff(place)
        i = np.lexsort((-gap, beyond.round(9)))[0]
        if (beyond[i].round(9), -gap[i]) < (wrong, -margin):
            best = HalfSpace(normal, float(place[i] + place[i + 1]) / 2)
            wrong, margin = beyond[i].round(9), gap[i]
    return best


def trimmed(mesh: trimesh.Trimesh, spaces: Sequence[HalfSpace]) -> trimesh.Trimesh:
    """A closed mesh without what is beyond; the mesh itself where nothing is, or nothing would be left."""
    beyond = [space for space in spaces if not space.holds(mesh.vertices).all()]
    return closed_difference(mesh, [_block_beyond(space, mesh) for space in beyond])


def _block_beyond(space: HalfSpace, mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """A box that holds all of a mesh that is beyond."""
    middle = mesh.bounds.mean(axis=0)
    size = 2 * float(np.linalg.norm(mesh.extents))
    on_plane = middle + (space.offset - middle @ space.normal) * space.normal
    pose = trimesh.geometry.align_vectors([0, 0, 1], space.normal)
    pose[:3, 3] = on_plane + size / 2 * space.normal
    return trimesh.creation.box((size, size, size), pose)
