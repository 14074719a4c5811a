"""The predicted object as a URDF that simulators and viewers open."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from lxml import etree
from torch import Tensor

from articulate_ssl.inference.articulation import canonical_object
from articulate_ssl.inference.part_colour import part_colour
from articulate_ssl.inference.part_mesh import part_mesh
from articulate_ssl.prediction import Prediction
from datamodules.atomic import atomic_write

JOINT_TYPE_NAMES = ("revolute", "prismatic")


def write_urdf(
    folder: Path,
    prediction: Prediction,  # B = 1, in the units that the URDF shall have
    limits: Tensor,  # [J, 2] lowest and highest joint state
    name: str,
) -> list[Path]:
    """Write `meshes/part_<k>.stl` and `object.urdf`: the canonical object, articulated by the predicted joints.

    Convention:
        The base link is the canonical object space. Every other link is parallel to it, with its origin on its joint's
        pivot. Meshes are stored in the canonical object space, and each visual shifts its mesh by minus the origin of
        its link: at the predicted states, base_pose @ (pose of link k) @ (origin of its visual) puts part k onto the
        scan. Limits are widened to hold the predicted states.

    Returns:
        The files written.
    """
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    joint_child = prediction.joint_child[0].tolist()
    origin = np.zeros((prediction.num_parts, 3))
    origin[joint_child] = prediction.canonical_pivot[0].numpy()

    robot = etree.Element("robot", name=name)
    files = []
    for k, shape in enumerate(canonical_object(prediction)[0].numpy()):
        files.append(folder / "meshes" / f"part_{k}.stl")
        with atomic_write(files[-1]) as file:
            file.write(part_mesh(shape).export(file_type="stl"))
        link = etree.SubElement(robot, "link", name=f"part_{k}")
        for tag in ("visual", "collision"):
            body = etree.SubElement(link, tag)
            etree.SubElement(body, "origin", xyz=_numbers(-origin[k]), rpy="0 0 0")
            etree.SubElement(etree.SubElement(body, "geometry"), "mesh", filename=f"meshes/{files[-1].name}")
            if tag == "visual":
                material = etree.SubElement(body, "material", name=f"part_{k}")
                etree.SubElement(material, "color", rgba=_numbers((*part_colour(k) / 255, 1)))

    for j, (lower, upper) in enumerate(limits.tolist()):
        parent, child = int(prediction.joint_parent[0, j]), joint_child[j]
        state = float(prediction.joint_state[0, j])
        joint = etree.SubElement(robot, "joint", name=f"joint_{j}", type=JOINT_TYPE_NAMES[prediction.joint_type[0, j]])
        etree.SubElement(joint, "origin", xyz=_numbers(origin[child] - origin[parent]), rpy="0 0 0")
        etree.SubElement(joint, "parent", link=f"part_{parent}")
        etree.SubElement(joint, "child", link=f"part_{child}")
        etree.SubElement(joint, "axis", xyz=_numbers(prediction.canonical_axis[0, j].tolist()))
        # The format demands effort and velocity, which no cloud tells.
        span = {"lower": _numbers([min(lower, state)]), "upper": _numbers([max(upper, state)])}
        etree.SubElement(joint, "limit", **span, effort="1", velocity="1")

    files.append(folder / "object.urdf")
    with atomic_write(files[-1]) as file:
        file.write(etree.tostring(robot, pretty_print=True, xml_declaration=True, encoding="utf-8"))
    return files


def _numbers(values: Iterable[float]) -> str:
    return " ".join(f"{value + 0.0:.9g}" for value in values)  # + 0.0 turns -0 into 0
