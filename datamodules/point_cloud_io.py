"""Reading a scan: from .ply, .pcd, .npy, .npz or .obj to a checked cloud, in the units and the frame of the file.

What commands predict and what `make data SOURCE=clouds` stores is read by this one function. A cloud that cannot be one
scan of an object is refused; pixels without depth, which depth cameras set to one place, and far outliers, which would
decide the scale of everything else, are left out and counted.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

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
# Share of the points that lie at one place, and times as many as at any other, from which on they are no surface.
# Quantised clouds repeat points, but many places about alike. Chosen.
_CROWDED, _CROWDED_MORE = 0.01, 10

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
    mesh vertices alone are a poor sample of flat parts. An .npz holds its cloud as `points`. Left out are points that
    all lie at one place, more than a hundredth of the cloud and more than ten times as many as at any other (organised
    clouds of depth cameras have all pixels without depth at the origin), and points more than five times as far from
    the median point as nine tenths of all points.

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
    """Points that came from anywhere, as a scan: what is no part of the object is left out as in `read_scan`.

    Raises:
        PointCloudError: if they are no usable cloud.
    """
    _check_cloud(name, points)
    points, notes = points.astype(np.float64), list(notes)
    for find in (_without_depth, _far_outliers):
        out, why = find(points)
        if out.any():
            points = points[~out]
            notes.append(f"{out.sum()} of {len(out)} points left out {why}")
            _check_cloud(f"{name}: {notes[-1]}", points)
    _refuse_few_places(name, points)
    _refuse_line(name, points)
    return Scan(points, tuple(notes))


def _without_depth(
    points: np.ndarray,  # [N, 3] float64
) -> tuple[np.ndarray, str]:  # [N] bool
    """Which points are pixels without depth, or pad the cloud, and what they are left out as."""
    place, count = _places(points)
    crowded = int(count.argmax())
    least = max(_CROWDED * len(points), _CROWDED_MORE * np.delete(count, crowded).max(initial=0))
    out = (place == crowded) & (count[crowded] > least)
    where = ", ".join(f"{value + 0.0:g}" for value in points[place == crowded][0])
    return out, f"as pixels without depth, or padding: all of them at exactly ({where})"


def _far_outliers(
    points: np.ndarray,  # [N, 3]
) -> tuple[np.ndarray, str]:  # [N] bool
    """Which points are far outliers, and what they are left out as."""
    distance = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    why = f"as outliers: more than {_FAR:g} times as far from the middle as nine tenths of all points"
    return ~(distance <= _FAR * np.quantile(distance, _WITHIN)), why


def _places(
    points: np.ndarray,  # [N, 3] finite
) -> tuple[np.ndarray, np.ndarray]:  # [N], [P]
    """The number of the place where each point lies, and how many points lie exactly there."""
    order = np.lexsort(points.T)  # a third of the time of np.unique
    ordered = points[order]
    place = np.zeros(len(points), dtype=np.int64)
    place[order[1:]] = np.cumsum((ordered[1:] != ordered[:-1]).any(axis=1))
    return place, np.bincount(place)


def _refuse_few_places(path: str | os.PathLike, points: np.ndarray) -> None:
    places = len(_places(points)[1])
    if places < MIN_POINTS:
        raise PointCloudError(
            f"{path}: its {len(points)} points lie at {places} different places, at least {MIN_POINTS} are needed; "
            "scan the object more densely, and do not repeat points"
        )


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
        except Exception as error:
            raise _not_plain_numpy(path) from error


def _load_numpy(path: Path) -> np.ndarray | np.lib.npyio.NpzFile:
    try:
        return np.load(path, allow_pickle=False)
    except Exception as error:  # damaged headers are parsed as Python, damaged archives by zlib: each fails in its way
        raise _not_plain_numpy(path) from error


def _not_plain_numpy(path: Path) -> PointCloudError:
    return PointCloudError(
        f"{path}: damaged, or pickled objects, which are not read because they can run code; save plain numbers with "
        "np.save(path, points.astype(np.float32))"
    )


def _read_pcd(path: Path) -> np.ndarray:
    # Imported here because it needs system libraries (libEGL, libusb) that no other format asks for.
    import open3d

    with path.open("rb") as file:
        header = {words[0]: words[1:] for words in _header(file, b"DATA")}
        ascii_rows = header.get(b"DATA") == [b"ascii"]
        if ascii_rows:
            columns = sum(map(_integer, header.get(b"COUNT", ())))
            _refuse_missing_rows(path, file, sum(map(_integer, header.get(b"POINTS", ()))), columns, "points")
    read = _read_pcd_rows if ascii_rows else _read_pcd_bytes
    try:
        with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
            points = read(path)
    except RuntimeError as error:
        raise PointCloudError(f"{path}: damaged, or of types that no .pcd has; export the cloud again") from error
    if not len(points):
        raise PointCloudError(f"{path}: damaged, or without any point; export the cloud again")
    return points


def _read_pcd_rows(path: Path) -> np.ndarray:
    """By the reader that keeps all digits, but reads zeros where a binary file has numbers of 8 bytes."""
    import open3d

    cloud = open3d.io.read_point_cloud(str(path), format="pcd", remove_nan_points=False, remove_infinite_points=False)
    return np.asarray(cloud.points)


def _read_pcd_bytes(path: Path) -> np.ndarray:
    """By the reader that keeps the numbers of the file, but seven digits of text only."""
    import open3d

    attributes = open3d.t.io.read_point_cloud(str(path), format="pcd").point
    return attributes.positions.numpy() if "positions" in attributes else np.empty((0, 3))


def _header(file: BinaryIO, last: bytes) -> list[list[bytes]]:
    """The words of every line up to the one that begins with `last`; of all lines if none does."""
    lines = []
    for line in file:
        if words := line.split():
            lines.append(words)
            if words[0] == last:
                break
    return lines


def _refuse_missing_rows(path: Path, file: BinaryIO, declared: int, columns: int, what: str) -> None:
    """Refuse a text file that ends too early; readers take what there is, or whatever was in memory, for the rest."""
    found = sum(len(line.split()) >= columns for line in file.read().splitlines())
    if found < declared:
        raise PointCloudError(f"{path}: damaged, cut off: {found} of {declared} {what}; export the cloud again")


def _integer(word: bytes) -> int:
    """Of a header; 0 for what is none, about which the reader of the file complains."""
    return int(word) if word.isdigit() else 0


def _refuse_cut_off_ply(path: Path) -> None:
    with path.open("rb") as file:
        header = _header(file, b"end_header")
        if [b"format", b"ascii"] in [words[:2] for words in header]:
            declared = sum(_integer(words[-1]) for words in header if words[0] == b"element")
            _refuse_missing_rows(path, file, declared, 1, "rows")


def _read_ply_or_obj(path: Path, notes: list[str]) -> np.ndarray:
    if path.suffix.lower() == ".ply":
        _refuse_cut_off_ply(path)
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
