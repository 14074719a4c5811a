"""Solid-modelling vocabulary of the procedural objects: watertight solids of manifold3d in the object frame.

Object frame: x right, y up, z towards the user, metres. Every helper returns a closed solid, and unions, differences
and hulls of closed solids are closed, so the part meshes need no repair.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh
from manifold3d import CrossSection, Manifold, Mesh64, OpType

SEGMENTS = 24  # edges of a full circle

# Columns: where the profile's two coordinates and the extrusion direction go.
_FRAMES = {
    "x": np.array([[0, 0, 1], [0, 1, 0], [1, 0, 0]], dtype=float),  # profile (z, y)
    "y": np.array([[1, 0, 0], [0, 0, 1], [0, 1, 0]], dtype=float),  # profile (x, z)
    "z": np.eye(3),  # profile (x, y)
}


def rounded_rectangle(width: float, height: float, radius: float, segments: int = SEGMENTS) -> CrossSection:
    """Centred rectangle with corners of the given radius, which is cut to half the shorter side."""
    radius = min(radius, 0.499 * min(width, height))
    if radius <= 0:
        return CrossSection.square((width, height), center=True)
    corner = CrossSection.circle(radius, segments)
    du, dv = width / 2 - radius, height / 2 - radius
    return CrossSection.batch_hull([corner.translate((su * du, sv * dv)) for su in (-1, 1) for sv in (-1, 1)])


def polygon(points: Sequence[Sequence[float]]) -> CrossSection:
    """Simple polygon, either winding."""
    points = np.asarray(points, dtype=float)
    u, v = points.T
    area = np.dot(u, np.roll(v, -1)) - np.dot(v, np.roll(u, -1))
    return CrossSection([points if area > 0 else points[::-1]])


def extrude(profile: CrossSection, axis: str, low: float, high: float) -> Manifold:
    """Profile extruded from `low` to `high` along "x" (profile in z, y), "y" (in x, z) or "z" (in x, y)."""
    return _orient(profile.extrude(high - low).translate((0, 0, low)), axis)


def box(low: Sequence[float], high: Sequence[float]) -> Manifold:
    """Axis-aligned box between two corners."""
    low, high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    return Manifold.cube(tuple(high - low)).translate(tuple(low))


def rounded_box(
    low: Sequence[float], high: Sequence[float], axis: str, corner: float, edge: float = 0.0, segments: int = SEGMENTS
) -> Manifold:
    """Box whose outline across `axis` has round corners, and whose two end faces have chamfers of size `edge`."""
    low, high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    u, v, w = (int(np.argmax(column)) for column in _FRAMES[axis].T)
    size, center = high - low, (high + low) / 2
    outline = rounded_rectangle(size[u], size[v], corner, segments)
    body = extrude(outline, axis, low[w] + edge, high[w] - edge)
    if edge > 0:
        inset = rounded_rectangle(size[u] - 2 * edge, size[v] - 2 * edge, corner - edge, segments)
        body = Manifold.batch_hull([body, extrude(inset, axis, low[w], high[w])])
    offset = center.copy()
    offset[w] = 0
    return body.translate(tuple(offset))


def cylinder(
    center: Sequence[float],
    axis: str,
    low: float,
    high: float,
    radius: float,
    top_radius: float | None = None,
    segments: int = SEGMENTS,
) -> Manifold:
    """Cylinder or cone between `low` and `high` along `axis`, through `center` (its coordinate there is unused)."""
    solid = Manifold.cylinder(high - low, radius, radius if top_radius is None else top_radius, segments)
    offset = np.array(center, dtype=float)
    offset["xyz".index(axis)] = 0
    return _orient(solid.translate((0, 0, low)), axis).translate(tuple(offset))


def revolve(profile: Sequence[Sequence[float]], axis: str, segments: int = SEGMENTS) -> Manifold:
    """Solid of revolution about a coordinate axis of the polygon in (radius, height along the axis)."""
    return _orient(polygon(profile).revolve(segments), axis)


def loft(
    rings: np.ndarray,  # [S, M, 3]
) -> Manifold:
    """Skin through S >= 2 convex rings of M points, with flat ends; rings wind counter-clockwise seen from the last."""
    sections, count = rings.shape[:2]
    u = np.arange(count)
    v = np.roll(u, -1)
    sides = [np.stack([u, v, v + count, u, v + count, u + count], axis=-1).reshape(-1, 3)]
    bands = np.concatenate([sides[0] + count * i for i in range(sections - 1)])
    fan = np.stack([np.zeros(count - 2, dtype=int), u[1:-1], v[1:-1]], axis=-1)
    faces = np.concatenate([bands, fan[:, ::-1], fan + count * (sections - 1)])
    return Manifold(Mesh64(rings.reshape(-1, 3), faces.astype(np.uint64)))


def union(solids: Sequence[Manifold]) -> Manifold:
    """Union of solids."""
    return _evaluated(Manifold.batch_boolean(list(solids), OpType.Add))


def subtract(solid: Manifold, tools: Sequence[Manifold]) -> Manifold:
    """Solid without all the tools."""
    return _evaluated(Manifold.batch_boolean([solid, *tools], OpType.Subtract))


def intersect(solid: Manifold, other: Manifold) -> Manifold:
    """What two solids share."""
    return _evaluated(solid ^ other)


def to_trimesh(solid: Manifold) -> trimesh.Trimesh:
    """Watertight triangle mesh of a solid."""
    mesh = solid.to_mesh64()
    return trimesh.Trimesh(np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts), process=False)


def _evaluated(solid: Manifold) -> Manifold:
    """The solid, computed now.

    Left to itself, manifold3d flattens nested operations that nothing else refers to, so that the triangles depend on
    whether a debugger, a profiler or a traceback happens to hold on to an operand. Hence no `+`, `-` and `^` on solids.
    """
    solid.num_tri()
    return solid


def _orient(solid: Manifold, axis: str) -> Manifold:
    return solid.transform(np.hstack([_FRAMES[axis], np.zeros((3, 1))]))
