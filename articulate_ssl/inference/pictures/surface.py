"""Closed meshes as lit triangles that a 2D drawing library can fill, the farthest first: no display, no OpenGL.

Triangles that face away are left out and the rest cut small, so that drawing them in the order of their distance hides
what is hidden, but for seams of the width of a triangle where parts pass through each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh

from articulate_ssl.inference.pictures.part_colour import part_colour

# Right, up, towards the viewer: from the upper left, and a weak one that keeps the other sides apart.
KEY_LIGHT = np.array([-0.36, 0.75, 0.56])
FILL_LIGHT = np.array([0.62, 0.1, 0.78])
# Shares of the part's colour: without light, by the key light, by the fill light. What exceeds the colour is white.
AMBIENT, KEY, FILL = 0.56, 0.42, 0.24
# Longest edge of a drawn triangle, as a share of the picture's width: coarser ones show through each other where a
# drawer leaves its case, finer ones take more than two seconds for the six panels of a chest.
TRIANGLE_SIZE = 0.03
# Hulls around noisy points are crumpled: faces that meet at less than this angle (radians) are lit as one curved
# surface. Below the right angles of furniture, above the folds of noise; chosen by looking at pictures.
SMOOTH_ANGLE = np.radians(35.0)


@dataclass(frozen=True)
class Surface:
    """A mesh cut into small triangles.

    Attributes:
        corners: [T, 3, 3] counter-clockwise seen from outside.
        normals: [T, 3] outward, unit, of the surface with its slight edges rounded off.
    """

    corners: np.ndarray
    normals: np.ndarray


@dataclass(frozen=True)
class LitTriangles:
    """Triangles in the order in which they are drawn.

    Attributes:
        corners: [T, 3, 2] right, up.
        colour: [T, 3] RGB from 0 to 1.
    """

    corners: np.ndarray
    colour: np.ndarray


def smooth_shaded(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The same surface, its vertices parted at sharp edges, so that its vertex normals round off the others only."""
    return trimesh.graph.smooth_shade(mesh, angle=SMOOTH_ANGLE)


def cut_small(
    meshes: Sequence[trimesh.Trimesh],  # part k's, closed
    width: float,
) -> list[Surface]:
    """The surfaces of an object's parts, ready to be drawn in any pose in a picture about as wide as `width`."""
    return [_cut_small(smooth_shaded(mesh), TRIANGLE_SIZE * width) for mesh in meshes]


def lit_triangles(
    surfaces: Sequence[Surface],  # part k's
    poses: np.ndarray,  # [K, 4, 4] into: right, up, towards the viewer
) -> LitTriangles:
    """All that faces the viewer, of parts coloured by their index."""
    lit = [_lit_part(surface, pose, k) for k, (surface, pose) in enumerate(zip(surfaces, poses, strict=True))]
    corners, colours = zip(*lit, strict=True)
    corners, colours = np.concatenate(corners), np.concatenate(colours)
    order = np.argsort(corners[:, :, 2].mean(axis=1))
    return LitTriangles(corners[order, :, :2], colours[order])


def _cut_small(mesh: trimesh.Trimesh, max_edge: float) -> Surface:
    """Cuts the longest edge of every triangle in half until none is longer than `max_edge`.

    trimesh's `subdivide_to_size` cuts into four, which makes ten times as many triangles of the slivers of a hull.
    """
    waiting = np.concatenate([mesh.triangles, mesh.vertex_normals[mesh.faces]], axis=2)
    done = []
    while len(waiting):
        edges = np.linalg.norm(waiting[:, :, :3] - np.roll(waiting[:, :, :3], -1, axis=1), axis=2)
        small = edges.max(axis=1) <= max_edge
        done.append(waiting[small])
        waiting, longest = waiting[~small], edges[~small].argmax(axis=1)
        index = np.arange(len(waiting))
        start, end, apex = (waiting[index, (longest + i) % 3] for i in range(3))
        middle = (start + end) / 2
        waiting = np.concatenate([np.stack([start, middle, apex], axis=1), np.stack([middle, end, apex], axis=1)])
    corners = np.concatenate(done)
    normals = corners[:, :, 3:].mean(axis=1)
    return Surface(corners[:, :, :3], normals / np.linalg.norm(normals, axis=1, keepdims=True).clip(min=1e-12))


def _lit_part(
    surface: Surface,
    pose: np.ndarray,  # [4, 4]
    part: int,
) -> tuple[np.ndarray, np.ndarray]:  # [T, 3, 3] corners, [T, 3] colours
    corners = surface.corners @ pose[:3, :3].T + pose[:3, 3]
    across, up = corners[:, 1, :2] - corners[:, 0, :2], corners[:, 2, :2] - corners[:, 0, :2]
    front = across[:, 0] * up[:, 1] - across[:, 1] * up[:, 0] > 0
    normals = surface.normals[front] @ pose[:3, :3].T
    light = AMBIENT + KEY * np.clip(normals @ KEY_LIGHT, 0, 1) + FILL * np.clip(normals @ FILL_LIGHT, 0, 1)
    colour, light = part_colour(part) / 255, light[:, None]
    return corners[front], np.where(light < 1, light * colour, 1 - (2 - light) * (1 - colour))
