"""From a raw link graph to an instance of a category: which joints are the category's, and what their coordinates mean.

What tells the parts of a category apart is data: the `recognition` of `render/categories/*.yaml`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from math import pi

import numpy as np

from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from render.articulated_object import ArticulatedObject
from render.category import CategorySpec
from render.sources.link_graph import LinkGraph, LinkJoint, merge_links

_TYPE_NAMES = {REVOLUTE: "revolute", PRISMATIC: "prismatic"}


def to_category(
    graph: LinkGraph,
    spec: CategorySpec,
    source: str,
    instance_id: str,
    front_known: bool = False,
) -> ArticulatedObject:
    """The instance of a category that a link graph describes.

    The joints of the result follow the category's convention whatever the data set's: coordinate 0 is the closed (for
    legs: unfolded) state and growing coordinates open (fold), see `orient_joints`. A category without parts of its own
    (`articulated`) takes all movable joints in stored order, with their own coordinates, axes and limits.

    Args:
        graph: The object, y up.
        spec: The category.
        source: Name of the source; selects the rules of `spec.recognition`.
        instance_id: Name of the object.
        front_known: Whether z is the front already. Otherwise the object is turned about y by the multiple of 90
            degrees that brings its front to z, see `front_rotation`.

    Raises:
        ValueError: naming the file, if the graph has no parts like the category's, or more than can be told apart.
    """
    if not spec.parts:
        modelled = graph.movable()
        if not modelled:
            raise ValueError(f"{graph.file}: no joint moves; an articulated object needs a movable joint")
        names = [graph.root, *(joint.child for joint in modelled)]
        return merge_links(graph, modelled, range(1, len(names)), names, instance_id, spec.name).validate()
    moved_parts = [joint.child for joint in spec.joints]

    def build(graph: LinkGraph, modelled: Sequence[LinkJoint]) -> ArticulatedObject:
        instance = merge_links(graph, modelled, moved_parts, spec.parts, instance_id, spec.name)
        stored = np.deg2rad(spec.recognition.rules(source).get("stored_deg", 0.0))
        return orient_joints(instance, [j.is_limited for j in modelled], spec.recognition.zero, stored)

    modelled = match_joints(graph, spec, source)
    if not front_known:
        rotation = front_rotation(build(graph, modelled).validate(), spec)
        graph = graph.rotated(rotation)
        modelled = match_joints(graph, spec, source)
    return build(graph, modelled).validate()


def require_rules(spec: CategorySpec, source: str) -> None:
    """Raise ValueError if a category with parts of its own does not say how to find them in a source."""
    if spec.parts and spec.recognition is None:
        raise ValueError(
            f"category {spec.name!r} does not say how to find its parts in source {source!r}: its file lacks "
            "`recognition`, see render/categories/laptop.yaml"
        )
    if spec.parts and source not in spec.recognition.sources:
        known = ", ".join(spec.recognition.sources)
        raise ValueError(f"source {source!r} has no objects of category {spec.name!r}; it can be read from {known}")


def joint_groups(spec: CategorySpec, source: str) -> dict[tuple[int, str], list[int]]:
    """Indices of the joints that a source cannot tell apart, by joint type and label pattern of the moved part."""
    groups: dict[tuple[int, str], list[int]] = {}
    for index, joint in enumerate(spec.joints):
        pattern = spec.recognition.rules(source).get("labels", {}).get(spec.parts[joint.child], "")
        groups.setdefault((joint.type, pattern), []).append(index)
    return groups


def match_joints(graph: LinkGraph, spec: CategorySpec, source: str) -> list[LinkJoint]:
    """The joints of the graph that are the category's, in its order.

    Joints are matched by type and number. If a type has more joints than the category, the label patterns of the source
    choose among them; if the source's labels are reliable (`labels_required`), only matching joints count at all. A
    source without labels (`first`) takes the first ones in stored order instead of refusing an object with more. Joints
    that the category cannot tell apart are numbered along its direction `order`, by the centre of what they move.

    Raises:
        ValueError: naming the file and its joints, if the numbers do not agree.
    """
    rules = spec.recognition.rules(source)
    matched: dict[int, LinkJoint] = {}
    for (joint_type, pattern), indices in joint_groups(spec, source).items():
        candidates = [joint for joint in graph.movable() if joint.type == joint_type]
        if rules.get("labels_required") or len(candidates) > len(indices):
            candidates = [joint for joint in candidates if re.search(pattern, joint.label, re.IGNORECASE)]
        if rules.get("first"):
            candidates = candidates[: len(indices)]
        if len(candidates) != len(indices):
            wanted = f"{len(indices)} {_TYPE_NAMES[joint_type]} joint(s)"
            wanted += f" labelled {pattern!r}" if pattern else ""
            found = ", ".join(f"{_TYPE_NAMES[j.type]} {j.name!r} ({j.label})" for j in graph.movable()) or "none"
            raise ValueError(
                f"{graph.file}: no matching parts for category {spec.name!r}: it needs {wanted}, the object has {found}"
            )
        direction = np.array(spec.recognition.order)
        candidates.sort(key=lambda joint: float(graph.surface_below(joint).bounds.mean(axis=0) @ direction))
        matched |= dict(zip(indices, candidates, strict=True))
    return [matched[index] for index in range(len(spec.joints))]


def orient_joints(
    instance: ArticulatedObject,
    limited: Sequence[bool],
    zero: str,
    stored: float,
) -> ArticulatedObject:
    """The instance, stored at coordinate 0 of every joint, with coordinates that start at the closed state and open.

    With q the data set's coordinate, the new one is s (q - q0), the axis s times the data set's:

    - A joint with limits: q0 is the limit at which the object's bounding box is smallest (largest for `zero ==
      "largest"`; within 1 % of each other: the limit nearer to the stored state), and s points into the limits. The new
      limits are [0, upper - lower].
    - A joint without limits: the object is stored at the new coordinate `stored`, and s is the direction in which 45
      degrees more make the bounding box larger (smaller). The new limits are [-pi, pi].

    Args:
        instance: J joints with the data set's coordinates.
        limited: Which of them have limits.
        zero: `smallest` or `largest`: the bounding box at coordinate 0, compared with the other states.
        stored: Coordinate, in the category's convention, at which joints without limits are stored.
    """
    joints = []
    for index, joint in enumerate(instance.joints):
        if limited[index]:
            ends = (joint.lower, joint.upper)
            sizes = [_diagonal(instance, index, end) for end in ends]
            if abs(sizes[0] - sizes[1]) <= 0.01 * max(sizes):
                origin = min(ends, key=abs)
            else:
                origin = ends[int((sizes[0] < sizes[1]) != (zero == "smallest"))]
            sign = 1 if origin == joint.lower else -1
            lower, upper, rest = 0.0, joint.upper - joint.lower, -sign * origin
        else:
            grows = _diagonal(instance, index, pi / 4) > _diagonal(instance, index, -pi / 4)
            sign = 1 if grows == (zero == "smallest") else -1
            lower, upper, rest = joint.lower, joint.upper, stored
        joints.append(replace(joint, axis=sign * joint.axis + 0.0, lower=lower, upper=upper, rest=rest + 0.0))
    return replace(instance, joints=tuple(joints))


def _diagonal(instance: ArticulatedObject, index: int, coordinate: float) -> float:
    states = np.array([joint.rest for joint in instance.joints])
    states[index] = coordinate
    return instance.at_rest(states).rest_diagonal


def front_rotation(instance: ArticulatedObject, spec: CategorySpec) -> np.ndarray:
    """Rotation [3, 3] about y, a multiple of 90 degrees, that brings the front of an instance to z.

    The front is the side of the base to which the moving parts have gone (`front: opposite`: from which they have gone)
    when hinges are open by 45 degrees and drawers entirely; legs are taken unfolded.
    """
    unfolded = spec.recognition.zero == "largest"
    states = [0.0 if unfolded else min(j.upper, pi / 4) if j.type == REVOLUTE else j.upper for j in instance.joints]
    centres = np.array([mesh.bounds.mean(axis=0) for mesh in instance.at_rest(states).meshes])
    moving = [joint.child for joint in instance.joints]
    direction = centres[moving].mean(axis=0) - centres[instance.base]
    if spec.recognition.front == "opposite":
        direction = -direction
    quarter_turns = np.rint(np.arctan2(direction[0], direction[2]) / (pi / 2))
    cosine, sine = np.rint([np.cos(quarter_turns * pi / 2), np.sin(quarter_turns * pi / 2)])
    return np.array([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]])
