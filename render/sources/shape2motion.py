"""Shape2Motion ("Motion Dataset V0"): the original layout and the re-packed copy of the ICLR'23 code ("MDV02").

Original: `<category>/<NNNN>/motion_attributes.json` and `part_objs/{none_motion,<dof_name>}.obj`. Re-packed: one
`summary.obj` per instance and `sfs_idx_to_dof_name_idx.npy`, which maps its triangles to the nodes of the JSON.

Frames: meshes and joints share one frame, taken to be y up (the models come from ShapeNet); no front is stated, it is
found from the motion of the parts. Units are the models' own. The data set has no joint limits.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh

from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from render.articulated_object import ArticulatedObject
from render.sources import Source
from render.sources.dataset_folder import find_instances, read_json
from render.sources.face_map import load_face_map
from render.sources.link_graph import FIXED, Link, LinkGraph, LinkJoint
from render.sources.mesh_loading import load_mesh, resolve_inside
from render.sources.part_matching import require_rules, to_category

if TYPE_CHECKING:
    from render.category import CategorySpec

SOURCE = "shape2motion"
# A spiral turns and slides at once, which is no joint of this library; its part stays with its parent's.
JOINT_TYPES = MappingProxyType({"none": FIXED, "spiral": FIXED, "rotation": REVOLUTE, "translation": PRISMATIC})


@dataclass(frozen=True)
class Shape2MotionSource(Source):
    """Shapes of one category, in either layout; ids are the folder names."""

    spec: CategorySpec
    folders: dict[str, Path]

    def instance_ids(self) -> list[str]:
        """Ids of all instances, sorted."""
        return list(self.folders)

    def load(self, instance_id: str) -> ArticulatedObject:
        """The instance, stored as modelled; the category says which state that is (`stored_deg`).

        Raises:
            ValueError: naming the file, what is wrong with it and what to do.
        """
        rules = self.spec.recognition.rules(SOURCE) if self.spec.parts else {}
        graph = read_shape(self.folders[instance_id], tuple(rules.get("exchanged_parts", ())))
        return to_category(graph, self.spec, SOURCE, instance_id)


def open(spec: CategorySpec, root: Path | None, seed: int) -> Shape2MotionSource:
    """Source of the shapes below `root`; `seed` is not used.

    Raises:
        ValueError: if the category is not in the data set or `root` holds no instance.
    """
    require_rules(spec, SOURCE)
    rules = spec.recognition.rules(SOURCE) if spec.parts else {}
    return Shape2MotionSource(spec, find_instances(root, "motion_attributes.json", rules.get("folders", ())))


def read_shape(folder: Path, exchanged_parts: tuple[int, ...] = ()) -> LinkGraph:
    """Links and joints of a `motion_attributes.json`, nodes in depth-first order, with the meshes of either layout.

    Args:
        folder: Of the instance.
        exchanged_parts: Two part indices of the face map that stand for each other's node (re-packed layout only).

    Raises:
        ValueError: naming the file, if it is malformed or a mesh is unusable.
    """
    file = folder / "motion_attributes.json"
    content = read_json(file)
    try:
        joints = _joints(content, parent="")
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise ValueError(f"{file}: is not a tree of motion nodes ({type(error).__name__}: {error})") from error
    names = [joint.child for joint in joints]
    if (folder / "part_objs").is_dir():
        stems = ["none_motion", *names[1:]]
        meshes = [load_mesh(resolve_inside(f"part_objs/{stem}.obj", folder, folder, file)) for stem in stems]
    else:
        meshes = _split_summary(folder, len(names), exchanged_parts)
    links = tuple(Link(name, mesh) for name, mesh in zip(names, meshes, strict=True))
    return LinkGraph(file, links, tuple(joints[1:]))


def _joints(node: dict[str, Any], parent: str) -> list[LinkJoint]:
    """The joint above a node and all joints below it, depth first; the root's has no parent."""
    name, motion = node["dof_name"], node["motion_type"]
    if motion not in JOINT_TYPES:
        raise ValueError(f"node {name!r} has unknown motion type {motion!r}; known are {', '.join(JOINT_TYPES)}")
    axis, pivot = (np.array(node[key], dtype=float).reshape(3) for key in ("direction", "center"))
    joint = LinkJoint(name, JOINT_TYPES[motion], parent, name, axis, pivot, label=name)
    return [joint, *(below for child in node.get("children") or () for below in _joints(child, name))]


def _split_summary(folder: Path, num_parts: int, exchanged_parts: tuple[int, ...]) -> list[trimesh.Trimesh]:
    mesh, file = load_mesh(folder / "summary.obj"), folder / "sfs_idx_to_dof_name_idx.npy"
    face_map = load_face_map(file)
    if face_map.keys() != set(range(len(mesh.faces))):
        raise ValueError(f"{file}: does not map the {len(mesh.faces)} triangles of summary.obj, it has {len(face_map)}")
    part = np.array([face_map[face] for face in range(len(mesh.faces))])
    if part.min() < 0 or part.max() >= num_parts:
        raise ValueError(
            f"{file}: has parts {part.min()} to {part.max()}, but motion_attributes.json {num_parts} nodes"
        )
    node_of_part = np.arange(num_parts)
    if exchanged_parts and max(exchanged_parts) < num_parts:
        node_of_part[list(exchanged_parts)] = exchanged_parts[::-1]
    node = node_of_part[part]
    return [trimesh.Trimesh(mesh.vertices, mesh.faces[node == i], process=False) for i in range(num_parts)]
