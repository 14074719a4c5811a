"""The predicted object as an MJCF model, MuJoCo's own format."""

from __future__ import annotations

from pathlib import Path

from lxml import etree
from scipy.spatial.transform import Rotation

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

GRAVITY = 9.81
JOINT_TYPES = {"revolute": "hinge", "prismatic": "slide"}


def write(result: ScanPrediction, folder: Path) -> list[Path]:
    """Write `meshes/part_<k>.stl` and `object.xml`: the object where the scan shows it.

    Convention:
        That of `rigid_links`; a body is a link, nested in its parent. The root body stands fixed at the predicted base
        pose, in the frame of the scan; for one that falls, add a `freejoint`. The key frame `scan` holds the predicted
        states. Parts that a joint connects do not collide: they meet at the joint, and MuJoCo collides convex hulls.
    Gravity acts along the scan's y where an upright camera took it, else along -z, for want of knowing better.

    Returns:
        The files written.
    """
    thing = rigid_object(result)
    meshes = write_meshes(thing, folder / MESH_FOLDER)
    file = folder / "object.xml"
    with atomic_write(file) as opened:
        opened.write(etree.tostring(_model(thing), pretty_print=True, encoding="utf-8"))
    return [*meshes, file]


def _model(thing: RigidObject) -> etree._Element:
    model = etree.Element("mujoco", model=thing.name)
    etree.SubElement(model, "compiler", angle="radian", meshdir=MESH_FOLDER)
    if thing.upright:
        etree.SubElement(model, "option", gravity=numbers([0, GRAVITY, 0]))
    assets = etree.SubElement(model, "asset")
    for link in thing.links:
        etree.SubElement(assets, "mesh", name=link.name, file=f"{link.name}.stl")
    quaternion = Rotation.from_matrix(thing.pose[:3, :3]).as_quat(scalar_first=True)
    # The scan may be far from its origin (in metres of a map), while all other lengths are of the object's size.
    where = {"pos": numbers(thing.pose[:3, 3], digits=15), "quat": numbers(quaternion)}
    visited = _add_body(etree.SubElement(model, "worldbody"), thing, thing.root, where)
    if thing.joints:
        contact = etree.SubElement(model, "contact")
        for joint in thing.joints:
            pair = {"body1": thing.links[joint.parent].name, "body2": thing.links[joint.child].name}
            etree.SubElement(contact, "exclude", **pair)
        states = numbers([joint.state for joint in visited])
        etree.SubElement(etree.SubElement(model, "keyframe"), "key", name="scan", qpos=states)
    return model


def _add_body(parent: etree._Element, thing: RigidObject, link: int, where: dict[str, str]) -> list[RigidJoint]:
    """Add a link and all that it carries; return the joints in the order of the file, which is that of qpos."""
    body = etree.SubElement(parent, "body", name=thing.links[link].name, **where)
    arriving = [joint for joint in thing.joints if joint.child == link]
    for joint in arriving:
        span = {"range": numbers([joint.lower, joint.upper]), "limited": "true"}
        etree.SubElement(body, "joint", name=joint.name, type=JOINT_TYPES[joint.kind], axis=numbers(joint.axis), **span)
    _add_substance(body, thing.links[link])
    carried = [_add_body(body, thing, j.child, {"pos": numbers(j.origin)}) for j in thing.joints_of(link)]
    return arriving + [joint for joints in carried for joint in joints]


def _add_substance(body: etree._Element, link: RigidLink) -> None:
    inertia = link.inertia[(0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)]
    mass = {"pos": numbers(link.center_of_mass), "mass": numbers([link.mass]), "fullinertia": numbers(inertia)}
    etree.SubElement(body, "inertial", **mass)
    look = {"rgba": numbers((*link.colour, 1)), "pos": numbers(-link.origin)}
    etree.SubElement(body, "geom", name=link.name, type="mesh", mesh=link.name, **look)
