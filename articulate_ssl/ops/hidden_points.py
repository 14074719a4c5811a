"""Which points of a sampled surface a camera sees: hidden point removal, then what patches of surface hide.

Katz, Tal and Basri, "Direct visibility of point sets", SIGGRAPH 2007: points are flipped at a large sphere about the
camera; those on the convex hull of the flipped points and the camera are seen. No normals, no mesh. But where surfaces
are as near to each other as samples are, as a closed door's front is to what is behind it, it lets some of the hidden
ones through, and boxes are rough where they have a door (docs/experiments.md, step 301). So of what it lets through, a
point is hidden, too, if its ray meets patches of surface before: discs about other such points, square to their
normals.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull

from articulate_ssl.ops.kd_tree import kd_tree

# Power of ten, of the farthest point's distance, that is the sphere's radius. By eye, on a washing machine of 4,096
# points seen from four sides: 1.0 loses slanted faces, 2.4 sees through closed ones.
_POWER = 1.7
# Of discs: radius, in distances between neighbouring points; of that radius, how far behind its plane a point has to
# be; and how many discs it takes, as normals are wrong at edges. Chosen on views of boxes of which depth images say
# what a camera sees.
_RADIUS, _BEHIND, _DISCS = 2.0, 0.4, 2
_NEAREST = 64  # rays by which a disc may be met


def seen_from_origin(
    points: np.ndarray,  # [N, 3] in the frame of a camera at the origin, none of them there
    normals: np.ndarray,  # [N, 3] unit, of either sign
) -> np.ndarray:  # [M] ascending
    """Indices of the points that nothing hides."""
    seen = _on_the_hull(points)
    return seen[~_behind_discs(points[seen], normals[seen])]


def _on_the_hull(points: np.ndarray) -> np.ndarray:
    """[M] ascending, see Katz et al."""
    distance = np.linalg.norm(points, axis=1, keepdims=True)
    flipped = points * (2 * distance.max() * 10**_POWER / distance - 1)
    hull = ConvexHull(np.concatenate([flipped, np.zeros((1, 3))])).vertices
    return np.sort(hull[hull < len(points)])


def _behind_discs(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """[M] bool, whether discs about the others hide a point."""
    distance = np.linalg.norm(points, axis=1)
    rays = points / distance[:, None]
    radius = _RADIUS * np.median(kd_tree(points).query(points, k=2)[0][:, 1])
    angle, disc = kd_tree(rays).query(rays, k=min(_NEAREST, len(rays)), distance_upper_bound=radius / distance.min())
    point, column = np.nonzero(np.isfinite(angle))
    disc = disc[point, column]
    plane = (points[disc] * normals[disc]).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):  # rays along the plane
        depth = plane / (rays[point] * normals[disc]).sum(axis=1)
        inside = np.linalg.norm(depth[:, None] * rays[point] - points[disc], axis=1) < radius
    behind = np.abs((points[point] * normals[disc]).sum(axis=1) - plane) > _BEHIND * radius
    hides = inside & behind & (depth > 0) & (depth < distance[point]) & (distance[disc] < distance[point])
    return np.bincount(point[hides], minlength=len(points)) >= _DISCS
