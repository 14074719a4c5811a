"""A dense cloud as a sampled surface: points with normals, and how far other oriented points are from it.

Distances between samples of one surface are half a spacing long even where nothing is wrong. Measured along normals
they vanish, which is what tells a drawer's side from the wall it slides along.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from articulate_ssl.ops.kd_tree import kd_tree

_NORMAL_NEIGHBOURS = 12
_NEIGHBOURS = 6  # surface samples that a query is compared with
_ALIKE = 0.8  # least cosine between the normals of a query and a sample on the same face
# Tangential distance to the nearest sample, in spacings, beyond which a query lies past the edge of the face. Chosen,
# as are the other numbers here.
_BEYOND = 2.0
_ON = 2.5  # distance, in spacings, within which a query lies on a sample


@dataclass(frozen=True)
class Surface:
    """Oriented samples of one cloud.

    Attributes:
        points: [N, 3].
        normals: [N, 3] unit, of either sign.
    """

    points: np.ndarray
    normals: np.ndarray

    @staticmethod
    def of(points: np.ndarray) -> Surface:
        """Normals from the plane of least squares through every point's neighbours."""
        around = points[kd_tree(points).query(points, k=_NORMAL_NEIGHBOURS)[1]]
        around = around - around.mean(axis=1, keepdims=True)
        return Surface(points, np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][..., 0])

    @cached_property
    def tree(self) -> cKDTree:
        """Of the points."""
        return kd_tree(self.points)

    @cached_property
    def spacing(self) -> float:
        """Median distance between neighbouring samples."""
        return float(np.median(self.tree.query(self.points, k=2)[0][:, 1]))

    def thinned(self, count: int) -> Surface:
        """The first `count` samples, an even selection where points are in farthest-point order."""
        return Surface(self.points[:count], self.normals[:count])

    def moved(
        self,
        pose: np.ndarray,  # [4, 4]
    ) -> Surface:
        """Under a pose."""
        turn = pose[:3, :3].T
        return Surface(self.points @ turn + pose[:3, 3], self.normals @ turn)

    def nearest(
        self,
        query: Surface,  # Q samples
        cap: float,
    ) -> np.ndarray:  # [Q]
        """Distance of oriented points to this surface, at most `cap`.

        Along the sample's normal, and past the edge of the face also along the face.
        """
        distance, index = self.tree.query(query.points, k=_NEIGHBOURS)
        along = np.abs(np.einsum("qki,qki->qk", self.normals[index], query.points[:, None] - self.points[index]))
        past = np.sqrt(np.maximum(distance**2 - along**2, 0)) - _BEYOND * self.spacing
        alike = np.abs(np.einsum("qki,qi->qk", self.normals[index], query.normals)) > _ALIKE
        error = np.where(alike, np.hypot(along, np.maximum(past, 0)), cap)
        return np.minimum(error.min(axis=1), cap)

    def under(
        self,
        query: Surface,  # Q samples
    ) -> np.ndarray:  # [Q]
        """The sample that each oriented point lies on, the nearest of those that face as it does; N if on none."""
        distance, index = self.tree.query(query.points, k=_NEIGHBOURS)
        alike = np.abs(np.einsum("qki,qi->qk", self.normals[index], query.normals)) > _ALIKE
        distance = np.where(alike, distance, np.inf)
        rows, best = np.arange(len(index)), distance.argmin(axis=1)
        return np.where(distance[rows, best] < _ON * self.spacing, index[rows, best], len(self.points))
