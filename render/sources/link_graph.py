"""The raw links and joints that a data set stores, and their merging into the parts of an articulated object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf, pi
from pathlib import Path

import numpy as np
import trimesh

from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from render.articulated_object import ArticulatedObject, Joint
from render.sources.mesh_loading import concatenate, transformed

FIXED = None
# Of a part, in any unit: rays are cast in single precision, which the squares of sizes far beyond these leave.
_SMALLEST, _LARGEST = 1e-12, 1e12


@dataclass(frozen=True)
class Link:
    """A rigid body: its surface in the object frame as stored, without faces if it has none of its own."""

    name: str
    mesh: trimesh.Trimesh


@dataclass(frozen=True)
class LinkJoint:
    """A joint between two links, in the object frame; coordinate 0 is the stored state.

    Attributes:
        name: Unique within the graph.
        type: `REVOLUTE`, `PRISMATIC` or `FIXED`.
        parent: Name of the link nearer to the root.
        child: Name of the link that this joint moves.
        axis: [3] direction, of any length but zero.
        pivot: [3] a point on the axis.
        lower: Smallest coordinate, radians or length; -inf if the data set states none.
        upper: Largest coordinate; inf if the data set states none.
        label: What the data set calls the moved link, for telling parts apart.
    """

    name: str
    type: int | None
    parent: str
    child: str
    axis: np.ndarray
    pivot: np.ndarray
    lower: float = -inf
    upper: float = inf
    label: str = ""

    @property
    def is_limited(self) -> bool:
        """Whether the limits end the motion: a revolute joint that may turn all the way round has none in effect."""
        return self.upper - self.lower < (inf if self.type == PRISMATIC else 2 * pi - 0.01)

    @property
    def direction(self) -> np.ndarray:  # [3]
        """The axis with length 1."""
        scaled = self.axis / np.abs(self.axis).max()  # squares of very large or small components leave float64
        return scaled / np.linalg.norm(scaled)


@dataclass(frozen=True)
class LinkGraph:
    """A tree of links, read from `file`."""

    file: Path
    links: tuple[Link, ...]
    joints: tuple[LinkJoint, ...]

    def __post_init__(self) -> None:
        """Raise ValueError, naming the file, if the graph is no tree or a joint is senseless."""
        tree_order([link.name for link in self.links], self.joints, self.file)
        for joint in self.joints:
            if joint.type is FIXED:
                continue
            where = f"{self.file}: joint {joint.name!r}"
            if not np.isfinite([*joint.axis, *joint.pivot]).all():
                raise ValueError(f"{where} has a NaN or infinite axis or origin")
            if np.abs(joint.axis).max() < 1e-9:
                raise ValueError(f"{where} has a zero axis; it needs a direction")
            if np.isnan([joint.lower, joint.upper]).any():
                raise ValueError(f"{where} has a NaN limit")
            if joint.lower > joint.upper:
                raise ValueError(f"{where} has reversed limits [{joint.lower:g}, {joint.upper:g}]; exchange them")
            if joint.lower == inf or joint.upper == -inf:
                raise ValueError(f"{where} has limits [{joint.lower:g}, {joint.upper:g}]; state a range to move over")

    def movable(self) -> list[LinkJoint]:
        """All joints but the fixed ones, in stored order."""
        return [joint for joint in self.joints if joint.type is not FIXED]

    @property
    def root(self) -> str:
        """Name of the link that no joint moves."""
        return tree_order([link.name for link in self.links], self.joints, self.file)[0]

    def surface_below(self, joint: LinkJoint) -> trimesh.Trimesh:
        """Surface of all links that a joint moves."""
        moved = [joint.child]
        for link in moved:  # grows while it is read
            moved += [other.child for other in self.joints if other.parent == link]
        surface = concatenate([link.mesh for link in self.links if link.name in moved])
        if len(surface.faces) == 0:
            raise ValueError(f"{self.file}: joint {joint.name!r} moves links without any mesh")
        return surface

    def rotated(
        self,
        rotation: np.ndarray,  # [3, 3]
    ) -> LinkGraph:
        """The graph stated in another object frame."""
        pose = np.eye(4)
        pose[:3, :3] = rotation
        links = tuple(replace(link, mesh=transformed(link.mesh, pose)) for link in self.links)
        joints = tuple(replace(j, axis=rotation @ j.axis, pivot=rotation @ j.pivot) for j in self.joints)
        return replace(self, links=links, joints=joints)

    def labelled(self, labels: Mapping[str, str]) -> LinkGraph:
        """The graph with the labels of links given by name; a link without one takes that of its only child."""

        def label(link: str) -> str:
            below = [joint.child for joint in self.joints if joint.parent == link]
            return labels.get(link) or (label(below[0]) if len(below) == 1 else "")

        return replace(self, joints=tuple(replace(joint, label=label(joint.child)) for joint in self.joints))


def tree_order(links: Sequence[str], joints: Sequence, file: Path) -> list[str]:
    """Link names, each after its parent. Joints need `name`, `parent` and `child` only.

    Raises:
        ValueError: naming the file, if the joints do not make one tree of all links.
    """
    for kind, names in (("link", links), ("joint", [joint.name for joint in joints])):
        if repeated := {name for name in names if names.count(name) > 1}:
            raise ValueError(f"{file}: {kind} name {min(repeated)!r} occurs more than once")
    parent_joint = {}
    for joint in joints:
        for link in (joint.parent, joint.child):
            if link not in links:
                raise ValueError(f"{file}: joint {joint.name!r} refers to unknown link {link!r}")
        if joint.child in parent_joint:
            raise ValueError(
                f"{file}: link {joint.child!r} is the child of two joints, "
                f"{parent_joint[joint.child].name!r} and {joint.name!r}"
            )
        parent_joint[joint.child] = joint
    order = [link for link in links if link not in parent_joint]
    if len(order) > 1:
        raise ValueError(f"{file}: no single root, links {', '.join(map(repr, order))} have no parent; connect them")
    children: dict[str, list[str]] = {}
    for joint in joints:
        children.setdefault(joint.parent, []).append(joint.child)
    for link in order:  # grows while it is read
        order += children.get(link, [])
    if unreached := [link for link in links if link not in order]:
        raise ValueError(f"{file}: the links {', '.join(map(repr, unreached)) or '(none)'} form a cycle, not a tree")
    if not order:
        raise ValueError(f"{file}: has no links")
    return order


def merge_links(
    graph: LinkGraph,
    modelled: Sequence[LinkJoint],
    moved_parts: Sequence[int],
    part_names: Sequence[str],
    instance_id: str,
    category: str,
) -> ArticulatedObject:
    """Articulated object with the modelled joints, in their order and with their own coordinates, stored at 0.

    Every link that no modelled joint moves joins the part of its parent, in the pose in which it is stored; the root's
    part is 0. Joints without limits get [-pi, pi].

    Args:
        graph: All links and joints of the object.
        modelled: J joints of the graph.
        moved_parts: The part index that each of them moves; together with 0 a permutation of all K.
        part_names: K names.
        instance_id: Name of the object.
        category: Its category.

    Raises:
        ValueError: naming the file, if a part has no surface or a modelled joint no motion.
    """
    meshes = {link.name: link.mesh for link in graph.links}
    joint_above = {joint.child: joint for joint in graph.joints}
    own_part = {joint.child: part for joint, part in zip(modelled, moved_parts, strict=True)}
    part_of: dict[str, int] = {}
    pieces: list[list[trimesh.Trimesh]] = [[] for _ in part_names]
    for link in tree_order(list(meshes), graph.joints, graph.file):
        part_of[link] = own_part[link] if link in own_part else part_of[joint_above[link].parent] if part_of else 0
        pieces[part_of[link]].append(meshes[link])
    merged = tuple(concatenate(part) for part in pieces)
    for name, mesh in zip(part_names, merged, strict=True):
        mesh.remove_unreferenced_vertices()
        if len(mesh.faces) == 0:
            raise ValueError(f"{graph.file}: part {name!r} is empty, none of its links has a mesh")
        if not _SMALLEST < (size := mesh.extents.max()) < _LARGEST:
            raise ValueError(
                f"{graph.file}: part {name!r} is {size:.3g} large; correct its mesh or mesh scale to a size between "
                f"{_SMALLEST:g} and {_LARGEST:g}"
            )
        if mesh.area <= 0:
            raise ValueError(f"{graph.file}: part {name!r} has no surface area, its mesh or mesh scale is degenerate")
    joints = tuple(_merged_joint(joint, part_of, graph.file) for joint in modelled)
    return ArticulatedObject(instance_id, category, tuple(part_names), merged, joints)


def _merged_joint(joint: LinkJoint, part_of: dict[str, int], file: Path) -> Joint:
    lower, upper = joint.lower, joint.upper
    if not joint.is_limited and joint.type == REVOLUTE:
        lower, upper = -pi, pi
    if not 0 < upper - lower < inf:
        raise ValueError(f"{file}: joint {joint.name!r} has limits [{lower:g}, {upper:g}]; state a range to move over")
    parent, child = part_of[joint.parent], part_of[joint.child]
    return Joint(joint.name, joint.type, parent, child, joint.direction, joint.pivot, lower, upper)
