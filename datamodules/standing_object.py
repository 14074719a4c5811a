"""The object in a scan that also shows what it stands on: a table, a floor.

What is predicted is of one object and nothing else, and few people have such scans. So the surface below is found as a
plane, by RANSAC, what lies above it falls into pieces that do not touch, and the largest that stands on that surface is
the object. Nothing of this knows a category.
"""

from __future__ import annotations

import logging
import os
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, Delaunay, QhullError, cKDTree

from datamodules.point_cloud_io import MIN_POINTS, PointCloudError, Scan, read_scan, usable_scan

_SAMPLE = 20000  # points of a scan that planes and pieces are looked for in
_PLANES = 6  # the largest that are looked at
_ITERATIONS = 1000  # of RANSAC, for each of them
_THICK = 0.0025  # of the scan's extent: how far points of a plane may be from it, before its own noise is known
_FEWEST = 0.05  # of the points; a smaller plane is no table
# Cosine of a plane's upward normal to the upward direction of a camera that is held upright, and may look down by 75
# degrees.
_UPRIGHT = 0.25
# Of two parallel planes the upper one is a part of what stands on the lower if it is less above it than this share of
# its own extent: the base of a laptop is, a table above a floor is not.
_PARALLEL, _LOW = np.cos(np.radians(10.0)), 0.3
_FITS, _CLOSE = 10, 2.5  # rounds of least squares, by points within so many standard deviations
_EXACT = 2e-4  # of a plane's extent: what is flatter than that is taken to be so flat
_NOISE = 4.0  # standard deviations of a plane's points within which nothing is told from it
# Pieces do not touch that are farther apart than this share of the extent of what stands there, and than so many times
# the distance of neighbours where these are sparse: seen from above upright faces are dense, and level ones are not.
_GAP, _SPACINGS, _NEIGHBOURS, _SPARSE = 0.02, 2, 5, 0.9
# A piece stands on a surface if so much of it is over so much of that: what only borders on it, as a wall, does not.
_WITHIN, _SHRUNK = 0.5, 0.97
# Of the object's extent, as far as it is known: so deep is what an open door hides of it. And the share of a piece that
# is within its outline if it is seen through the object.
_HIDDEN, _SEEN_WITHIN = 0.25, 0.8

logger = logging.getLogger(__name__)


def load_standing_object(path: str | os.PathLike) -> np.ndarray:  # [N, 3] float64
    """`standing_object` of a file, in its frame and unit; what was left out is logged as a warning that names the file.

    Raises:
        PointCloudError: see `standing_object` and `read_scan`.
    """
    scan = standing_object(path, read_scan(path))
    for note in scan.notes:
        logger.warning("%s: %s", path, note)
    return scan.points


class _Plane(NamedTuple):
    """Points x with normal . x + offset = 0; the normal points up.

    Attributes:
        normal: [3] unit.
        points: [n, 3] of the sample, those on it.
        noise: Standard deviation of these.
    """

    normal: np.ndarray
    offset: float
    points: np.ndarray
    noise: float

    def height(self, points: np.ndarray) -> np.ndarray:
        """[...] of points [..., 3] above it."""
        return points @ self.normal + self.offset

    @property
    def extent(self) -> float:
        """Length that its points span."""
        return _extent(self.points)


def standing_object(name: str | os.PathLike, scan: Scan) -> Scan:
    """What stands on the largest surface of a scan, without the surface and whatever else there is.

    In the frame of a depth camera (all z positive) surfaces lie below a camera that is held upright; elsewhere they are
    below most of the other points.

    Args:
        name: Of the scan, for messages.

    Returns:
        The object, and the notes of the scan with one about what was left out.

    Raises:
        PointCloudError: if there is no such surface, or nothing that could be an object stands on it.
    """
    points = scan.points
    sample = points if len(points) <= _SAMPLE else np.random.default_rng(0).permutation(points)[:_SAMPLE]
    camera = bool((sample[:, 2] > 0).all())
    planes = _planes(sample, camera)
    for plane in planes:
        if any(_lies_on(plane, other) for other in planes):
            continue
        found = _standing_on(plane, points, sample, camera)
        if found is not None:
            note = (
                f"{len(points) - len(found)} of {len(points)} points left out: what the object stands on, what is "
                "beside it, and what is too near to either to tell"
            )
            return usable_scan(name, found, (*scan.notes, note))
    problem = "nothing stands on its flat surfaces" if planes else "it has no flat surface below an object"
    raise PointCloudError(
        f"{name}: {problem}; the scan must show the object and a part of the table or floor around it, the camera held "
        "upright (x right, y down, z forward). If it shows the object alone, leave --on-table out"
    )


def _planes(
    sample: np.ndarray,  # [n, 3]
    camera: bool,
) -> list[_Plane]:
    """The surfaces that something may stand on, largest first."""
    import open3d

    rest, found = sample, []
    tolerance = _THICK * _extent(sample)
    for _ in range(_PLANES):
        if len(rest) < max(MIN_POINTS, _FEWEST * len(sample)):
            break
        open3d.utility.random.seed(0)
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(rest))
        equation, inliers = cloud.segment_plane(tolerance, 3, _ITERATIONS)
        others = np.delete(rest, inliers, axis=0)
        plane = _Plane(equation[:3], float(equation[3]), rest[inliers], tolerance)
        above = plane.offset if camera else plane.height(np.median(others if len(others) else rest, axis=0))
        if above < 0:
            plane = plane._replace(normal=-plane.normal, offset=-plane.offset)
        plane = _fitted(plane, rest)
        upright = -plane.normal[1] > _UPRIGHT or not camera
        if upright and len(inliers) >= _FEWEST * len(sample):
            found.append(plane)
        rest = rest[np.abs(plane.height(rest)) > _CLOSE * plane.noise]
    return found


def _fitted(
    plane: _Plane,
    points: np.ndarray,  # [n, 3]
) -> _Plane:
    """The plane of least squares through those points that its own noise explains, which is known from below it.

    What lies flat on a table is above that.
    """
    for _ in range(_FITS):
        height = plane.height(points)
        below = height[(height <= 0) & (height >= -_NOISE * plane.noise)]
        noise = max(1.4826 * float(np.median(np.append(-below, 0.0))), _EXACT * plane.extent)
        near = points[np.abs(height) <= _CLOSE * noise]
        if len(near) < MIN_POINTS:
            break
        normal = np.linalg.svd(near - near.mean(axis=0), full_matrices=False)[2][2]
        normal = np.copysign(1.0, normal @ plane.normal) * normal
        plane = _Plane(normal, float(-normal @ near.mean(axis=0)), near, noise)
    return plane


def _lies_on(upper: _Plane, lower: _Plane) -> bool:
    """Whether a plane is of something that stands on another."""
    height = np.median(lower.height(upper.points))
    return bool(upper.normal @ lower.normal > _PARALLEL and lower.noise < height < _LOW * upper.extent)


def _standing_on(
    plane: _Plane,
    points: np.ndarray,  # [N, 3]
    sample: np.ndarray,  # [n, 3] of them
    camera: bool,
) -> np.ndarray | None:  # [M, 3]
    """The largest piece of what is above a surface, and over it; None if there is none.

    Pieces are apart as seen from above: a lid that hides the hinge it turns about is over its base.
    """
    import open3d

    least, across = _NOISE * plane.noise, np.linalg.svd(plane.normal[None])[2][1:].T  # [3, 2]
    shown, above = plane.points @ across, sample[plane.height(sample) > least] @ across
    over = _inside(shown, above)
    if over.sum() < MIN_POINTS:
        return None
    gap = max(_GAP * _extent(above[over]), _SPACINGS * _spacing(above[over]))
    flat = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(np.pad(above, ((0, 0), (0, 1)))))
    piece = np.asarray(flat.cluster_dbscan(gap, min_points=_NEIGHBOURS))
    size, within = np.bincount(piece[piece >= 0]), np.bincount(piece[(piece >= 0) & over], minlength=piece.max() + 1)
    standing = np.where(within >= _WITHIN * size, size, 0)
    if not standing.any():
        return None
    ours = piece == standing.argmax()
    if camera:
        seen = sample[plane.height(sample) > least]
        ours = _with_what_it_hides(ours, piece, standing, above, seen[:, :2] / seen[:, 2:])
    near, _ = cKDTree(above[ours]).query(points @ across, distance_upper_bound=gap)
    found = points[np.isfinite(near) & (plane.height(points) > least)]
    return found if len(found) >= MIN_POINTS else None


def _with_what_it_hides(
    ours: np.ndarray,  # [n] bool, the largest piece
    piece: np.ndarray,  # [n]
    standing: np.ndarray,  # [p] size of those that are over the surface
    above: np.ndarray,  # [n, 2] from above
    image: np.ndarray,  # [n, 2] as the camera sees them
) -> np.ndarray:  # [n] bool
    """With pieces that a camera sees apart since something of the object hides what joins them.

    They border on it in the image and are near to it, as a body behind its open door; or are seen within its outline,
    and not farther away than it is large, as the inside of a cupboard.
    """
    left, border = {k for k in np.flatnonzero(standing) if not (ours & (piece == k)).any()}, _SPACINGS * _spacing(image)
    while left:
        reach, tree, outline = _extent(above[ours]), cKDTree(image[ours]), _inside(image[ours], image, shrunk=1.0)
        distance, _ = cKDTree(above[ours]).query(above)
        joined = set()
        for k in left:
            own = piece == k
            borders = (tree.query(image[own])[0] < border).sum() >= _NEIGHBOURS
            inside = outline[own].mean() >= _SEEN_WITHIN
            if (borders and distance[own].min() < _HIDDEN * reach) or (inside and np.median(distance[own]) < reach):
                joined.add(k)
        if not joined:
            break
        ours, left = ours | np.isin(piece, list(joined)), left - joined
    return ours


def _inside(
    shown: np.ndarray,  # [m, 2]
    points: np.ndarray,  # [n, 2]
    shrunk: float = _SHRUNK,
) -> np.ndarray:  # [n] bool
    """Which points are within its border, or well within."""
    try:
        border = shown[ConvexHull(shown).vertices]
        middle = border.mean(axis=0)
        return Delaunay(middle + shrunk * (border - middle)).find_simplex(points) >= 0
    except QhullError:  # a line
        return np.zeros(len(points), dtype=bool)


def _extent(
    points: np.ndarray,  # [n, d]
) -> float:
    """Length of the diagonal of the box about all but a twentieth of the points, on either side of each axis."""
    low, high = np.quantile(points, [0.05, 0.95], axis=0)
    return float(np.linalg.norm(high - low))


def _spacing(
    points: np.ndarray,  # [n, d]
) -> float:
    """Distance to the fifth nearest point (`_NEIGHBOURS`) where points are sparse."""
    return float(np.quantile(cKDTree(points).query(points, k=_NEIGHBOURS + 1)[0][:, -1], _SPARSE))
