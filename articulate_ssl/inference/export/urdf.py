"""The predicted object as a URDF that simulators and viewers open."""

from __future__ import annotations

from pathlib import Path

from lxml import etree

from articulate_ssl.inference.export.rigid_links import (
    MESH_FOLDER,
    RigidJoint,
    RigidLink,
    RigidObject,
    rigid_object,
    write_meshes,
)
from articulate_ssl.inference.export.xml_numbers import numbers
from articulate_ssl.inference.scan_prediction import ScanPrediction
from datamodules.atomic import atomic_write


def write(result: ScanPrediction, folder: Path) -> list[Path]:
    """Write `meshes/part_<k>.stl` and `object.urdf`: the canonical object, articulated by the predicted joints.

    Convention:
        That of `rigid_links`. Meshes are stored in the canonical object space, and each visual shifts its mesh by minus
        the origin of its link: at the predicted states, base_pose @ (pose of link k) @ (origin of its visual) puts part
        k onto the scan. Poses of the scan are not in the file: a URDF has no place for the pose of its root.

    Returns:
        The files written.
    """
    thing = rigid_object(result)
    meshes = write_meshes(thing, folder / MESH_FOLDER)
    robot = etree.Element("robot", name=thing.name)
    _add_mujoco_options(robot)
    for link in thing.links:
        _add_link(robot, link)
    for joint in thing.joints:
        _add_joint(robot, thing, joint)
    file = folder / "object.urdf"
    with atomic_write(file) as opened:
        opened.write(etree.tostring(robot, pretty_print=True, xml_declaration=True, encoding="utf-8"))
    return [*meshes, file]


def _add_mujoco_options(robot: etree._Element) -> None:
    """What MuJoCo needs to find the meshes and to keep the root link; other readers skip the element."""
    etree.SubElement(etree.SubElement(robot, "mujoco"), "compiler", strippath="false", fusestatic="false")


def _add_link(robot: etree._Element, link: RigidLink) -> None:
    element = etree.SubElement(robot, "link", name=link.name)
    inertial = etree.SubElement(element, "inertial")
    etree.SubElement(inertial, "origin", xyz=numbers(link.center_of_mass), rpy="0 0 0")
    etree.SubElement(inertial, "mass", value=numbers([link.mass]))
    names = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
    moments = {name: numbers([link.inertia[index]]) for name, index in names.items()}
    etree.SubElement(inertial, "inertia", **moments)
    for tag in ("visual", "collision"):
        body = etree.SubElement(element, tag)
        etree.SubElement(body, "origin", xyz=numbers(-link.origin), rpy="0 0 0")
        etree.SubElement(etree.SubElement(body, "geometry"), "mesh", filename=f"{MESH_FOLDER}/{link.name}.stl")
        if tag == "visual":
            material = etree.SubElement(body, "material", name=link.name)
            etree.SubElement(material, "color", rgba=numbers((*link.colour, 1)))


def _add_joint(robot: etree._Element, thing: RigidObject, joint: RigidJoint) -> None:
    element = etree.SubElement(robot, "joint", name=joint.name, type=joint.kind)
    etree.SubElement(element, "origin", xyz=numbers(joint.origin), rpy="0 0 0")
    etree.SubElement(element, "parent", link=thing.links[joint.parent].name)
    etree.SubElement(element, "child", link=thing.links[joint.child].name)
    etree.SubElement(element, "axis", xyz=numbers(joint.axis))
    # The format demands effort and velocity, which no cloud tells.
    span = {"lower": numbers([joint.lower]), "upper": numbers([joint.upper])}
    etree.SubElement(element, "limit", **span, effort="1", velocity="1")
