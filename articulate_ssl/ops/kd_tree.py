"""Nearest neighbours among the points of one cloud."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree


def kd_tree(points: np.ndarray) -> cKDTree:
    """SciPy's tree of points [N, D], safe while denormal numbers are flushed (`ops.denormals`).

    Where more than half of a node's points have the same coordinate zero, as on a face in a coordinate plane, balancing
    it would split at the smallest number above zero. Flushed, that is zero again, and SciPy (1.17) recurses until it
    crashes. Splitting in the middle never gets there.
    """
    return cKDTree(points, balanced_tree=False)
