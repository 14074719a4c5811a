"""A user's scan: from .ply, .pcd, .npy, .npz or .obj to the normalised cloud that the network reads."""

from __future__ import annotations

import logging
import os
import zipfile
from pathlib import Path

import numpy as np
import trimesh

from articulate_ssl.ops.farthest_point import farthest_point_order
from datamodules.atomic import atomic_write

MIN_POINTS = 128
MESH_SAMPLES = 16384
SUFFIXES = (".ply", ".pcd", ".npy", ".npz", ".obj")

logger = logging.getLogger(__name__)


class PointCloudError(ValueError):
    """A scan is missing, unreadable or unusable; the message names the file and the remedy."""


def load_point_cloud(path: str | os.PathLike) -> np.ndarray:  # [N, 3] float64
    """Read a scan of one object, in the units and the frame of the file.

    A .ply or .obj that holds a mesh gives `MESH_SAMPLES` points, drawn uniformly over its surface with a fixed seed,
    and logs that it did so: mesh vertices alone are a poor sample of flat parts. An .npz holds its cloud as `points`.

    Raises:
        PointCloudError: if the file is missing, of an unsupported kind, damaged, or holds no usable cloud.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise PointCloudError(
            f"{path}: cannot read a {suffix or 'suffix-less'} file; convert it to {', '.join(SUFFIXES)}"
        )
    if not path.is_file():
        raise PointCloudError(f"{path}: no such file; check the path of the point cloud")
    if path.stat().st_size == 0:
        raise PointCloudError(f"{path}: the file is empty; export the point cloud again")
    reader = {".npy": _read_npy, ".npz": _read_npz, ".pcd": _read_pcd}.get(suffix, _read_ply_or_obj)
    points = reader(path)
    _check_cloud(path, points)
    return points.astype(np.float64)


def save_coloured_ply(
    path: str | os.PathLike,
    points: np.ndarray,  # [N, 3]
    colours: np.ndarray,  # [N, 3] uint8
) -> None:
    """Write a coloured cloud as binary PLY (float32 positions), whole or not at all."""
    content = trimesh.PointCloud(points, colors=colours).export(file_type="ply")
    with atomic_write(path) as file:
        file.write(content)


def normalise_cloud(
    points: np.ndarray,  # [N, 3]
    num_points: int,
    center: np.ndarray | None = None,  # [3]
    scale: float | None = None,
) -> tuple[np.ndarray, np.ndarray, float]:
    """The network's input: (points - center) / scale, evenly thinned to `num_points`, in farthest-point order.

    Without `center` and `scale` they are those of the honest partial protocol, from the observed points alone: the
    mean, and the mean distance to it divided by 0.3. Clouds of more than `MESH_SAMPLES` points are thinned at random
    (fixed seed) first. A cloud of fewer than `num_points` points repeats its points from the beginning.

    Returns:
        Normalised points [num_points, 3] float32, center [3] float64, scale.
    """
    points = np.asarray(points, dtype=np.float64)
    if center is None:
        center = points.mean(axis=0)
    if scale is None:
        scale = float(np.linalg.norm(points - center, axis=1).mean() / 0.3)
    normalised = ((points - center) / scale).astype(np.float32)
    if len(normalised) > MESH_SAMPLES:
        normalised = np.random.default_rng(0).permutation(normalised)[:MESH_SAMPLES]
    order = farthest_point_order(normalised, min(num_points, len(normalised)))
    return np.resize(normalised[order], (num_points, 3)), np.asarray(center, dtype=np.float64), scale


def _check_cloud(path: Path, points: np.ndarray) -> None:
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        raise PointCloudError(
            f"{path}: expected one cloud, numbers of shape [N, 3]; found {points.dtype} of shape {list(points.shape)}; "
            "save the x, y, z columns of one cloud only"
        )
    if len(points) < MIN_POINTS:
        held = {0: "no points", 1: "one point"}.get(len(points), f"{len(points)} points")
        raise PointCloudError(f"{path}: holds {held}, at least {MIN_POINTS} are needed; scan the object more densely")
    bad = int((~np.isfinite(points)).any(axis=1).sum())
    if bad:
        raise PointCloudError(
            f"{path}: {bad} of {len(points)} points are NaN or infinite; remove them "
            "(points[np.isfinite(points).all(axis=1)])"
        )
    if np.ptp(points, axis=0).max() <= 1e-9 * max(1e-30, np.abs(points).max()):
        raise PointCloudError(f"{path}: all {len(points)} points coincide; check the unit and the export of the scan")


def _read_npy(path: Path) -> np.ndarray:
    points = _load_numpy(path)
    if not isinstance(points, np.ndarray):
        raise PointCloudError(f"{path}: is an .npz archive; rename it to {path.with_suffix('.npz').name}")
    return points


def _read_npz(path: Path) -> np.ndarray:
    arrays = _load_numpy(path)
    if isinstance(arrays, np.ndarray):
        raise PointCloudError(f"{path}: is a single array; rename it to {path.with_suffix('.npy').name}")
    with arrays:
        if "points" not in arrays:
            raise PointCloudError(
                f"{path}: has no array `points`, only {', '.join(arrays.files) or 'nothing'}; "
                "save the cloud with np.savez(path, points=points)"
            )
        try:
            return arrays["points"]
        except (ValueError, EOFError, OSError, zipfile.BadZipFile) as error:
            raise _not_plain_numpy(path) from error


def _load_numpy(path: Path) -> np.ndarray | np.lib.npyio.NpzFile:
    try:
        return np.load(path, allow_pickle=False)
    except (ValueError, EOFError, OSError, zipfile.BadZipFile) as error:
        raise _not_plain_numpy(path) from error


def _not_plain_numpy(path: Path) -> PointCloudError:
    return PointCloudError(
        f"{path}: damaged, or pickled objects, which are not read because they can run code; save plain numbers with "
        "np.save(path, points.astype(np.float32))"
    )


def _read_pcd(path: Path) -> np.ndarray:
    # Imported here because it needs system libraries (libEGL, libusb) that no other format asks for.
    import open3d

    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        cloud = open3d.io.read_point_cloud(
            str(path), format="pcd", remove_nan_points=False, remove_infinite_points=False
        )
    if cloud.is_empty():
        raise PointCloudError(f"{path}: damaged, or without any point; export the cloud again")
    return np.asarray(cloud.points)


def _read_ply_or_obj(path: Path) -> np.ndarray:
    try:
        scene = trimesh.load_scene(path, process=False, skip_materials=True)
    except Exception as error:  # damaged files make the parsers raise whatever their next line raises
        raise PointCloudError(
            f"{path}: damaged, or not a {path.suffix} file ({error}); export the cloud again"
        ) from error
    geometries = scene.dump()
    surfaces = [g for g in geometries if isinstance(g, trimesh.Trimesh) and len(g.faces)]
    if not surfaces:
        clouds = [np.asarray(g.vertices) for g in geometries]
        return np.concatenate(clouds) if clouds else np.empty((0, 3))
    mesh = trimesh.util.concatenate(surfaces)
    if not np.isfinite(mesh.vertices).all():
        raise PointCloudError(f"{path}: the mesh has NaN or infinite vertices; repair it or export it again")
    if mesh.area <= 0:
        raise PointCloudError(f"{path}: the mesh has no surface area; check the unit and the export of the scan")
    logger.warning("%s is a mesh: using %d points sampled uniformly over its surface", path, MESH_SAMPLES)
    return np.asarray(trimesh.sample.sample_surface(mesh, MESH_SAMPLES, seed=0)[0])
