"""Meshes from files of unknown origin: the surface, or one clear error."""

from __future__ import annotations

import io
from itertools import pairwise
from pathlib import Path

import defusedxml.ElementTree
import numpy as np
import trimesh
from defusedxml.common import DefusedXmlException

MESH_TYPES = ("obj", "stl", "dae", "glb", "ply")


def resolve_inside(
    reference: str,
    folder: Path,
    root: Path,
    file: Path,
) -> Path:
    """Path that `reference`, found in `file` and relative to `folder`, points to.

    Raises:
        ValueError: if it leads, also by a symbolic link, out of both `root` and the folder of `file`.
    """
    target = (folder / reference).resolve()
    if not any(target.is_relative_to(allowed.resolve()) for allowed in (root, file.parent)):
        raise ValueError(f"{file}: {reference!r} points to {target}, outside {root}; move the file into that folder")
    return target


def load_mesh(path: Path) -> trimesh.Trimesh:
    """Surface stored in an obj, stl, dae, glb or ply file, all its pieces in one mesh.

    Vertices and faces are as stored (quads split, nothing merged or removed), materials are not read. A COLLADA file is
    scaled to metres by its own unit.

    Raises:
        ValueError: if the file is missing, of another type, damaged, without faces, or has NaN or infinite vertices.
    """
    file_type = path.suffix.lower().removeprefix(".")
    if file_type not in MESH_TYPES:
        raise ValueError(f"{path}: mesh type {path.suffix!r} is not supported; convert it to {', '.join(MESH_TYPES)}")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: mesh is missing or unreadable ({error.strerror})") from error
    if file_type == "dae":
        parse_xml(data, path)
    try:
        if file_type == "obj":
            data = _plain_obj(data)
        # Without a resolver the mesh cannot make the loader open further files.
        scene = trimesh.load_scene(io.BytesIO(data), file_type=file_type, resolver=None, process=False)
    except Exception as error:  # the loaders raise whatever a damaged file runs them into
        raise ValueError(f"{path}: not a readable {file_type} mesh ({type(error).__name__}: {error})") from error
    pieces = [
        _piece(scene.geometry[name], scene.graph.get(node)[0], file_type)
        for node in scene.graph.nodes_geometry
        for name in [scene.graph.get(node)[1]]
        if isinstance(scene.geometry[name], trimesh.Trimesh)
    ]
    return checked_mesh(concatenate(pieces), path)


def _plain_obj(data: bytes) -> bytes:
    """Vertices and triangles of an obj alone, with absolute indices.

    trimesh regroups faces by material, which face-to-part maps do not survive, and counts negative indices from the end
    of the file instead of from the face.
    """
    lines, num_vertices = [], 0
    for line in data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines():
        keyword, *values = line.split() or [b""]
        if keyword == b"v":
            num_vertices += 1
            lines.append(b"v " + b" ".join(values[:3]))
        elif keyword == b"f":
            relative = [int(value.split(b"/")[0]) for value in values]
            indices = [i if i >= 0 else i + num_vertices + 1 for i in relative]
            if len(indices) < 3 or min(indices) < 1:
                raise ValueError(f"bad face {line.decode(errors='replace')!r}")
            first, *others = indices
            lines += [b"f %d %d %d" % (first, *pair) for pair in pairwise(others)]
    return b"\n".join(lines) + b"\n"


def _piece(mesh: trimesh.Trimesh, pose: np.ndarray, file_type: str) -> trimesh.Trimesh:
    scale = trimesh.units.unit_conversion(mesh.units, "meters") if file_type == "dae" and mesh.units else 1.0
    return transformed(mesh, np.diag([scale, scale, scale, 1.0]) @ pose)


def transformed(
    mesh: trimesh.Trimesh,
    transform: np.ndarray,  # [4, 4], any affine transform
) -> trimesh.Trimesh:
    """Bare surface under an affine transform; a mirrored one keeps its faces turned outwards."""
    vertices = trimesh.transform_points(mesh.vertices, transform)
    faces = mesh.faces if np.linalg.det(transform[:3, :3]) > 0 else mesh.faces[:, ::-1]
    return trimesh.Trimesh(vertices, faces, process=False)


def concatenate(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    """One bare surface out of many, faces in order; empty if there are none."""
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    vertices = np.concatenate([np.empty((0, 3)), *(mesh.vertices for mesh in meshes)])
    faces = [mesh.faces + offset for mesh, offset in zip(meshes, offsets, strict=False)]
    return trimesh.Trimesh(vertices, np.concatenate([np.empty((0, 3), dtype=np.int64), *faces]), process=False)


def checked_mesh(mesh: trimesh.Trimesh, file: Path) -> trimesh.Trimesh:
    """The mesh, if it has a surface.

    Raises:
        ValueError: naming the file, if the mesh is empty, has NaN or infinite vertices or refers to vertices it lacks.
    """
    if len(mesh.faces) == 0:
        raise ValueError(f"{file}: mesh is empty, it has no faces")
    if not np.isfinite(mesh.vertices).all():
        raise ValueError(f"{file}: mesh has NaN or infinite vertices")
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise ValueError(f"{file}: mesh has faces that refer to vertices it does not have")
    return mesh


def parse_xml(data: bytes, file: Path):
    """Root element of an XML document that declares no DTD and no entities.

    Raises:
        ValueError: naming the file, if the document is malformed or declares what could expand without bound.
    """
    try:
        return defusedxml.ElementTree.fromstring(data, forbid_dtd=True)
    except DefusedXmlException as error:
        raise ValueError(
            f"{file}: declares a DTD or entities, which can expand without bound; remove the DOCTYPE"
        ) from error
    except (defusedxml.ElementTree.ParseError, ValueError, LookupError) as error:
        raise ValueError(f"{file}: not well-formed XML ({error})") from error
