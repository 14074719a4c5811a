"""HOI4D's articulated CAD models: the release (`articulated/<Category>/<NNN>`) and the re-packed copy (`<type>/<NNN>`).

Frames: metres, z up (verified for safes), no front stated; turned to y up, the front is found from the motion of the
parts. `objs/<stem>.obj` lies in the frame of the joints; the `-align` and `_align` meshes beside it are parts in frames
of their own, which only the object poses of the videos refer to, and are not read.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, pi
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from render.articulated_object import ArticulatedObject
from render.sources import Source
from render.sources.dataset_folder import find_instances, read_json
from render.sources.link_graph import FIXED, Link, LinkGraph, LinkJoint
from render.sources.mesh_loading import concatenate, load_mesh, resolve_inside
from render.sources.part_matching import require_rules, to_category
from render.sources.urdf import Z_UP_TO_Y_UP

if TYPE_CHECKING:
    from render.category import CategorySpec

SOURCE = "hoi4d"
JUNK = "junk"
JOINT_TYPES = MappingProxyType(
    {
        "自由": FIXED, "静态": FIXED, "沉重": FIXED, "铰链（旋转）": REVOLUTE, "滑动": PRISMATIC,
        "free": FIXED, "static": FIXED, "heavy": FIXED, "hinge": REVOLUTE, "slider": PRISMATIC, "slider+": PRISMATIC,
    }
)  # fmt: skip
_ROOT = "base"
_PREFIXES = (".", "articulated", "HOI4D_CAD_Model_for_release/articulated")


@dataclass(frozen=True)
class Hoi4dSource(Source):
    """CAD models of one category; ids are the folder names."""

    spec: CategorySpec
    folders: dict[str, Path]
    excluded: tuple[str, ...]

    def instance_ids(self) -> list[str]:
        """Ids of all instances, sorted."""
        return list(self.folders)

    def left_out(self) -> dict[str, str]:
        """The folders that the category excludes by name."""
        return dict.fromkeys(self.excluded, f"the category {self.spec.name!r} excludes the model by its name")

    def load(self, instance_id: str) -> ArticulatedObject:
        """The instance, stored as modelled.

        Raises:
            ValueError: naming the file, what is wrong with it and what to do.
        """
        graph = read_mobility_v2(self.folders[instance_id]).rotated(Z_UP_TO_Y_UP)
        return to_category(graph, self.spec, SOURCE, instance_id)


def open(spec: CategorySpec, root: Path | None, seed: int) -> Hoi4dSource:
    """Source of the CAD models below `root`, without the instances that the category excludes; `seed` is not used.

    Raises:
        ValueError: if the category is not in the data set or `root` holds no instance that it does not exclude.
    """
    require_rules(spec, SOURCE)
    rules = spec.recognition.rules(SOURCE) if spec.parts else {}
    found = find_instances(root, "mobility_v2.json", rules.get("folders", ()), _PREFIXES)
    excluded = tuple(i for i in found if i in rules.get("exclude", ()))
    if len(excluded) == len(found):
        raise ValueError(
            f"{root}: no instance is left, category {spec.name!r} excludes {', '.join(excluded)}; name another folder, "
            f"or take it as category 'articulated'"
        )
    return Hoi4dSource(spec, {i: folder for i, folder in found.items() if i not in excluded}, excluded)


def read_mobility_v2(folder: Path) -> LinkGraph:
    """Links and joints of a `mobility_v2.json`, with the meshes that the `result.json` beside it names.

    Nodes of joint type junk are dropped. Hinge limits are degrees in the file. If limit a exceeds b, the motion is
    [-a, -b] about the opposite axis; limits beyond a full turn are wrapped; `noLimit` means none.

    Raises:
        ValueError: naming the file, if it is malformed or a mesh is unusable.
    """
    file = folder / "mobility_v2.json"
    nodes = read_json(file)
    if not isinstance(nodes, list):
        raise ValueError(f"{file}: is not a list of nodes")
    meshes = _meshes_of_parts(folder)
    links, joints = [Link(_ROOT, concatenate([]))], []
    for index, node in enumerate(nodes):
        try:
            if node["joint"] == JUNK:
                continue
            joint = _joint(node)
            parts = [part["id"] for part in node["parts"]]
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ValueError(f"{file}: node {index} is malformed ({type(error).__name__}: {error})") from error
        if unknown := [part for part in parts if part not in meshes]:
            raise ValueError(f"{file}: node {index} has part {unknown[0]!r}, which {folder / 'result.json'} lacks")
        paths = [path for part in parts for path in meshes[part]]
        links.append(Link(joint.child, concatenate([load_mesh(path) for path in paths])))
        joints.append(joint)
    return LinkGraph(file, tuple(links), tuple(joints))


def _joint(node: dict[str, Any]) -> LinkJoint:
    if node["joint"] not in JOINT_TYPES:
        raise ValueError(f"unknown joint type {node['joint']!r}; known are {', '.join(JOINT_TYPES)}")
    joint_type = JOINT_TYPES[node["joint"]]
    parent = _ROOT if node["parent"] == -1 else f"link_{node['parent']}"
    name, child = f"joint_{node['id']}", f"link_{node['id']}"
    if joint_type is FIXED:
        return LinkJoint(name, FIXED, parent, child, np.zeros(3), np.zeros(3), label=node["name"])
    axis = np.array(node["jointData"]["axis"]["direction"], dtype=float).reshape(3)
    pivot = np.array(node["jointData"]["axis"]["origin"], dtype=float).reshape(3)
    limit, lower, upper = node["jointData"]["limit"], -inf, inf
    if not limit["noLimit"]:
        lower, upper = float(limit["a"]), float(limit["b"])
        if lower > upper:
            axis, lower, upper = -axis, -lower, -upper
        if joint_type == REVOLUTE:
            lower, upper = np.deg2rad([lower, upper])
            if max(abs(lower), abs(upper)) > 2 * pi:
                turns = 2 * pi * np.rint((lower + upper) / (4 * pi))
                lower, upper = lower - turns, upper - turns
    return LinkJoint(name, joint_type, parent, child, axis, pivot, float(lower), float(upper), node["name"])


def _meshes_of_parts(folder: Path) -> dict[int, list[Path]]:
    """Mesh files of every node of the part tree: its own and those of all nodes below."""
    file = folder / "result.json"
    content = read_json(file)

    def walk(node: dict[str, Any]) -> list[Path]:
        stems = [stem for stem in node.get("objs") or () if not stem.endswith(("-align", "_align"))]
        paths = [resolve_inside(f"objs/{stem}.obj", folder, folder, file) for stem in stems]
        for child in node.get("children") or ():
            paths += walk(child)
        meshes[node["id"]] = paths
        return paths

    meshes: dict[int, list[Path]] = {}
    try:
        for node in content if isinstance(content, list) else [content]:
            walk(node)
    except (KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{file}: is not a tree of parts ({type(error).__name__}: {error})") from error
    return meshes
