"""A closed mesh around the points of a predicted part shape."""

from __future__ import annotations

import numpy as np
import trimesh

from articulate_ssl.ops.kd_tree import kd_tree

HULL_SLACK = 2.5
ALPHA_RADII = (1.5, 1.75, 2.0, 2.25, 2.5, 3.0, 4.0, 6.0)
MIN_THICKNESS = 1e-3
# Of coordinates near one: a few times what float32 numbers resolve. For points that all but coincide.
LEAST_THICKNESS = 1e-6
# Points that are all at the origin have no size of their own.
SMALLEST_UNIT = 1e-12


def part_mesh(
    points: np.ndarray,  # [M, 3] unordered points on the surface of the part
) -> trimesh.Trimesh:
    """The convex hull where it fits the points, else the tightest closed alpha shape, else the convex hull.

    The hull is exact for lids, doors and panels, and keeps them thin. Reconstructions that need normals (Poisson, ball
    pivoting) blow a plate up or tear it, because its two sides are closer than its points. The hull fits if all of
    its surface lies within `HULL_SLACK` point spacings (median distance between neighbours) of a point: on even samples
    of plates with noise up to their thickness the largest gap is 1.0-2.6 spacings, on a case with one open side 4.
    Alpha shapes, of radii `ALPHA_RADII` in spacings, follow cavities and holes down to about two spacings. Points
    without volume give a plate or rod, `MIN_THICKNESS` of their extent thick. Vertices are float32 numbers, so that a
    file of such numbers is as closed as the mesh.
    """
    points = np.asarray(points, dtype=np.float64)
    # Tolerances of the libraries suit sizes near one. A power of two changes no digit.
    unit = 2.0 ** np.ceil(np.log2(max(float(np.abs(points).max()), SMALLEST_UNIT)))
    mesh = _mesh_of_unit_size(np.unique(_as_float32(points / unit), axis=0))
    mesh.apply_scale(unit)
    return mesh


def _mesh_of_unit_size(
    points: np.ndarray,  # [M, 3] float32 numbers, without repetition
) -> trimesh.Trimesh:
    solid = _as_float32(_with_volume(points))
    hull = trimesh.convex.convex_hull(solid)
    if len(solid) > len(points):
        return hull
    tree = kd_tree(points)
    spacing = float(np.median(tree.query(points, k=2)[0][:, 1]))
    gaps = tree.query(trimesh.sample.sample_surface(hull, 2000, seed=0)[0])[0]
    if gaps.max() <= HULL_SLACK * spacing:
        return hull
    for radius in ALPHA_RADII:
        mesh = _alpha_shape(points, radius * spacing)
        if mesh.is_volume and mesh.body_count == 1:
            return mesh
    return hull


def _alpha_shape(points: np.ndarray, radius: float) -> trimesh.Trimesh:
    # Imported here because it needs system libraries (libEGL, libusb) that convex parts can do without.
    import open3d

    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
        shape = open3d.geometry.TriangleMesh.create_from_point_cloud_alpha_shape(cloud, radius)
    mesh = trimesh.Trimesh(np.asarray(shape.vertices), np.asarray(shape.triangles))
    mesh.fix_normals()
    return mesh


def _as_float32(points: np.ndarray) -> np.ndarray:
    return np.asarray(points, dtype=np.float32).astype(np.float64)


def _with_volume(points: np.ndarray) -> np.ndarray:
    directions = np.linalg.eigh(np.cov(points, rowvar=False, bias=True))[1]
    extent = np.ptp(points @ directions, axis=0)
    thickness = max(MIN_THICKNESS * float(extent.max()), LEAST_THICKNESS)
    for direction in directions.T[extent < thickness]:
        points = np.concatenate([points - direction * thickness / 2, points + direction * thickness / 2])
    return points
