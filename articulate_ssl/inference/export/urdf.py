"""The predicted object as a URDF that simulators and viewers open."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from lxml import etree

from articulate_ssl.inference.articulation import canonical_object
from articulate_ssl.inference.export.part_mesh import part_mesh
from articulate_ssl.inference.pictures.part_colour import part_colour
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.inference.scan_prediction import JOINT_TYPE_NAMES, ScanPrediction
from datamodules.atomic import atomic_write

MESH_FOLDER = "meshes"


def write(result: ScanPrediction, folder: Path) -> list[Path]:
    """Write `meshes/part_<k>.stl` and `object.urdf`: the canonical object, articulated by the predicted joints.

    Convention:
        The base link is the canonical object space. Every other link is parallel to it, with its origin on its joint's
        pivot. Meshes are stored in the canonical object space, and each visual shifts its mesh by minus the origin of
        its link: at the predicted states, base_pose @ (pose of link k) @ (origin of its visual) puts part k onto the
        scan. Limits are widened to hold the predicted states.

    Returns:
        The files written.
    """
    prediction = result.prediction
    origin = np.zeros((prediction.num_parts, 3))
    origin[prediction.joint_child[0].tolist()] = prediction.canonical_pivot[0].numpy()
    meshes = _write_meshes(folder / MESH_FOLDER, canonical_object(prediction)[0].numpy())

    robot = etree.Element("robot", name=result.category)
    for k, mesh in enumerate(meshes):
        _add_link(robot, k, mesh, origin[k])
    for j, (lower, upper) in enumerate(result.limits.tolist()):
        _add_joint(robot, prediction, j, origin, lower, upper)
    file = folder / "object.urdf"
    with atomic_write(file) as opened:
        opened.write(etree.tostring(robot, pretty_print=True, xml_declaration=True, encoding="utf-8"))
    return [*meshes, file]


def _write_meshes(
    folder: Path,
    shapes: np.ndarray,  # [K, M, 3]
) -> list[Path]:
    folder.mkdir(exist_ok=True)
    files = [folder / f"part_{k}.stl" for k in range(len(shapes))]
    for file, shape in zip(files, shapes, strict=True):
        with atomic_write(file) as opened:
            opened.write(part_mesh(shape).export(file_type="stl"))
    return files


def _add_link(
    robot: etree._Element,
    part: int,
    mesh: Path,
    origin: np.ndarray,  # [3] of the link, in canonical object space
) -> None:
    link = etree.SubElement(robot, "link", name=f"part_{part}")
    for tag in ("visual", "collision"):
        body = etree.SubElement(link, tag)
        etree.SubElement(body, "origin", xyz=_numbers(-origin), rpy="0 0 0")
        etree.SubElement(etree.SubElement(body, "geometry"), "mesh", filename=f"{MESH_FOLDER}/{mesh.name}")
        if tag == "visual":
            material = etree.SubElement(body, "material", name=f"part_{part}")
            etree.SubElement(material, "color", rgba=_numbers((*part_colour(part) / 255, 1)))


def _add_joint(
    robot: etree._Element,
    prediction: Prediction,  # B = 1
    joint: int,
    origin: np.ndarray,  # [K, 3] of the links, in canonical object space
    lower: float,
    upper: float,
) -> None:
    parent, child = int(prediction.joint_parent[0, joint]), int(prediction.joint_child[0, joint])
    state = float(prediction.joint_state[0, joint])
    kind = JOINT_TYPE_NAMES[prediction.joint_type[0, joint]]
    element = etree.SubElement(robot, "joint", name=f"joint_{joint}", type=kind)
    etree.SubElement(element, "origin", xyz=_numbers(origin[child] - origin[parent]), rpy="0 0 0")
    etree.SubElement(element, "parent", link=f"part_{parent}")
    etree.SubElement(element, "child", link=f"part_{child}")
    etree.SubElement(element, "axis", xyz=_numbers(prediction.canonical_axis[0, joint].tolist()))
    # The format demands effort and velocity, which no cloud tells.
    span = {"lower": _numbers([min(lower, state)]), "upper": _numbers([max(upper, state)])}
    etree.SubElement(element, "limit", **span, effort="1", velocity="1")


def _numbers(values: Iterable[float]) -> str:
    return " ".join(f"{value + 0.0:.9g}" for value in values)  # + 0.0 turns -0 into 0
