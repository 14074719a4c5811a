"""Reading a scan: from .ply, .pcd, .npy, .npz or .obj to a checked cloud, in the units and the frame of the file.

What commands predict and what `make data SOURCE=clouds` stores is read by this one function. A cloud that cannot be one
scan of an object is refused; far outliers, which would decide the scale of everything else, are left out and counted.
"""

from __future__ import annotations

import logging
import os
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

MIN_POINTS = 128
MESH_SAMPLES = 16384
SUFFIXES = (".ply", ".pcd", ".npy", ".npz", ".obj")
# A cloud thinner than a thousandth of its length, in both other directions, is a line; nothing that has parts is.
_LINE = 1e-3
# Times the distance from the median point within which nine tenths of the points lie. Of clouds of all procedural
# categories none reaches beyond 1.7 times; five spares what is longer and thinner.
_FAR = 5.0
_WITHIN = 0.9

logger = logging.getLogger(__name__)


class PointCloudError(ValueError):
    """A scan is missing, unreadable or unusable; the message names the file and the remedy."""


@dataclass(frozen=True)
class Scan:
    """A cloud that can be used.

    Attributes:
        points: [N, 3] float64, in the units and the frame of the file.
        notes: What its user should know: that a mesh was sampled, that points were left out.
    """

    points: np.ndarray
    notes: tuple[str, ...]


def load_point_cloud(path: str | os.PathLike) -> np.ndarray:  # [N, 3] float64
    """The points of `read_scan`; its notes are logged as warnings that name the file.

    Raises:
        PointCloudError: see `read_scan`.
    """
    scan = read_scan(path)
    for note in scan.notes:
        logger.warning("%s: %s", path, note)
    return scan.points


def read_scan(path: str | os.PathLike) -> Scan:
    """Read a scan of one object.

    A .ply or .obj that holds a mesh gives `MESH_SAMPLES` points, drawn uniformly over its surface with a fixed seed:
    mesh vertices alone are a poor sample of flat parts. An .npz holds its cloud as `points`. Points more than five
    times as far from the median point as nine tenths of all points are left out.

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
    reader = {".npy": _read_npy, ".npz": _read_npz, ".pcd": _read_pcd}.get(suffix)
    notes = []
    points = _read_ply_or_obj(path, notes) if reader is None else reader(path)
    return usable_scan(path, points, notes)


def usable_scan(
    name: str | os.PathLike,  # for messages
    points: np.ndarray,  # [N, 3]
    notes: Sequence[str] = (),  # what is known about it already
) -> Scan:
    """Points that came from anywhere, as a scan: far outliers are left out as in `read_scan`.

    Raises:
        PointCloudError: if they are no usable cloud.
    """
    _check_cloud(name, points)
    points, notes = points.astype(np.float64), list(notes)
    near = _near(points)
    if not near.all():
        points = points[near]
        notes.append(
            f"{(~near).sum()} of {len(near)} points left out as outliers: more than {_FAR:g} times as far from the "
            "middle as nine tenths of all points"
        )
        _check_cloud(name, points)
    _refuse_line(name, points)
    return Scan(points, tuple(notes))


def _near(
    points: np.ndarray,  # [N, 3]
) -> np.ndarray:  # [N] bool
    """Which points are no far outliers."""
    distance = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    return distance <= _FAR * np.quantile(distance, _WITHIN)


def _refuse_line(path: str | os.PathLike, points: np.ndarray) -> None:
    length, width, _ = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if width <= _LINE * length:
        raise PointCloudError(
            f"{path}: all {len(points)} points lie on one line; check that x, y and z are the scan's three coordinates"
        )


def _check_cloud(path: str | os.PathLike, points: np.ndarray) -> None:
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


def _read_ply_or_obj(path: Path, notes: list[str]) -> np.ndarray:
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
    notes.append(f"is a mesh: using {MESH_SAMPLES} points sampled uniformly over its surface")
    return np.asarray(trimesh.sample.sample_surface(mesh, MESH_SAMPLES, seed=0)[0])
