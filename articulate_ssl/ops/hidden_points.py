"""Which points of a sampled surface a camera sees: hidden point removal.

Katz, Tal and Basri, "Direct visibility of point sets", SIGGRAPH 2007: points are flipped at a large sphere about the
camera; those on the convex hull of the flipped points and the camera are seen. No normals, no mesh.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull

# Power of ten, of the farthest point's distance, that is the sphere's radius. By eye, on a washing machine of 4,096
# points seen from four sides: 1.0 loses slanted faces, 2.4 sees through closed ones.
_POWER = 1.7


def seen_from_origin(
    points: np.ndarray,  # [N, 3] in the frame of a camera at the origin, none of them there
) -> np.ndarray:  # [M] ascending
    """Indices of the points that nothing hides."""
    distance = np.linalg.norm(points, axis=1, keepdims=True)
    flipped = points * (2 * distance.max() * 10**_POWER / distance - 1)
    hull = ConvexHull(np.concatenate([flipped, np.zeros((1, 3))])).vertices
    return np.sort(hull[hull < len(points)])
