"""Objects described by URDF files: any folder of them, or one file.

Frames: URDF has z up and states no front (REP 103), so z is turned to the y of the canonical object frame and the front
is found from the motion of the parts (`render.sources.part_matching`).
A file with another axis up at its root gives an object that lies on its side, from which partial views then look at it;
a fixed joint above its root link sets it upright.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from math import inf
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np
import trimesh
import yourdfpy

from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from render.articulated_object import ArticulatedObject
from render.sources import Source
from render.sources.dataset_folder import files_below
from render.sources.link_graph import FIXED, Link, LinkGraph, LinkJoint, tree_order
from render.sources.mesh_loading import concatenate, load_mesh, parse_xml, resolve_inside, transformed
from render.sources.part_matching import require_rules, to_category

if TYPE_CHECKING:
    from render.category import CategorySpec

Z_UP_TO_Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
JOINT_TYPES = MappingProxyType({"fixed": FIXED, "revolute": REVOLUTE, "continuous": REVOLUTE, "prismatic": PRISMATIC})
# The children and the attributes that are read of an element; the others may hold what they like.
_READ = {
    "robot": (("link", "joint"), ("name",)),
    "link": (("visual",), ("name",)),
    "visual": (("origin", "geometry"), ()),
    "joint": (("parent", "child", "origin", "axis", "limit", "mimic"), ("name", "type")),
    "limit": ((), ("lower", "upper")),
    "mimic": ((), ("joint",)),
}
# How many blank-separated numbers the attributes that matter here may hold.
_NUMBERS = {
    "origin": {"xyz": (3,), "rpy": (3,)},
    "axis": {"xyz": (3,)},
    "limit": {"lower": (1,), "upper": (1,)},
    "mesh": {"scale": (1, 3)},
    "box": {"size": (3,)},
    "cylinder": {"radius": (1,), "length": (1,)},
    "sphere": {"radius": (1,)},
}
_SIZED = {"box": ["size"], "cylinder": ["radius", "length"], "sphere": ["radius"]}
_SHAPES = {"mesh": ["filename"]} | _SIZED


@dataclass(frozen=True)
class UrdfSource(Source):
    """Instances are URDF files; their ids are the paths below the root folder, without `.urdf`."""

    spec: CategorySpec
    root: Path
    files: dict[str, Path]

    def instance_ids(self) -> list[str]:
        """Ids of all instances, sorted."""
        return sorted(self.files)

    def load(self, instance_id: str) -> ArticulatedObject:
        """The instance with the category's parts and joints, stored at the URDF's zero configuration.

        Raises:
            ValueError: naming the file, what is wrong with it and what to do.
        """
        graph = read_urdf(self.files[instance_id], self.root).rotated(Z_UP_TO_Y_UP)
        return to_category(graph, self.spec, "urdf", instance_id)


def open(spec: CategorySpec, root: Path | None, seed: int) -> UrdfSource:
    """Source of all `*.urdf` files (of any case) below a folder, or of one file; `seed` is not used.

    Raises:
        ValueError: if there are none.
    """
    require_rules(spec, "urdf")
    if root is None:
        raise ValueError("source 'urdf' needs a root: a folder that holds URDF files, or one such file")
    root = Path(root)
    if root.is_file():
        return UrdfSource(spec, root.parent, {root.stem: root})
    if not root.is_dir():
        raise ValueError(f"{root}: no such folder")
    found = [path for path in files_below(root) if path.suffix.lower() == ".urdf"]
    if not found:
        raise ValueError(f"{root}: no *.urdf file in this folder")
    return UrdfSource(spec, root, {path.relative_to(root).as_posix().removesuffix(".urdf"): path for path in found})


def read_urdf(file: Path, root: Path, below_root: bool = False) -> LinkGraph:
    """Links and joints of a URDF in the frame of its root link, at the zero configuration.

    Visual geometry only. A `<limit>` needs no effort and velocity, axes need no unit length, zero may lie outside the
    limits. Mesh paths are relative to the file; `package://name/path` is looked for below every folder from the file's
    up to `root`.

    Args:
        file: The URDF.
        root: Folder that no mesh path may leave.
        below_root: State the graph in the frame of the first link below the root instead of the root's own.

    Raises:
        ValueError: naming the file, if it is malformed, describes no tree, has a mimic, planar or floating joint, or
            refers to a mesh that cannot be used.
    """
    robot = _parse(file)
    poses = _link_poses(robot, file)
    if below_root and robot.joints:
        first = next(joint.child for joint in robot.joints if joint.parent == next(iter(poses)))
        poses = {name: np.linalg.solve(poses[first], pose) for name, pose in poses.items()}
    links = tuple(
        Link(link.name, concatenate([_surface(v, poses[link.name], file, root) for v in link.visuals]))
        for link in robot.links
    )
    return LinkGraph(file, links, tuple(_joint(joint, poses[joint.child], file) for joint in robot.joints))


def _parse(file: Path) -> yourdfpy.urdf.Robot:
    try:
        data = file.read_bytes()
    except OSError as error:
        raise ValueError(f"{file}: cannot be read ({error.strerror})") from error
    xml = parse_xml(data, file)
    if xml.tag != "robot":
        raise ValueError(f"{file}: is not a URDF, its outermost element is <{xml.tag}> instead of <robot>")
    xml.attrib.setdefault("name", file.stem)
    _drop_unread(xml)
    _check_required(xml, file)
    _check_numbers(xml, file)
    stream = io.BytesIO(ElementTree.tostring(xml))
    try:
        return yourdfpy.URDF.load(stream, build_scene_graph=False, load_meshes=False).robot
    except Exception as error:  # it raises whatever a malformed file runs it into
        raise ValueError(f"{file}: not a readable URDF ({type(error).__name__}: {error})") from error


def _drop_unread(element: ElementTree.Element) -> None:
    if element.tag not in _READ:
        return
    children, attributes = _READ[element.tag]
    element.attrib = {name: value for name, value in element.attrib.items() if name in attributes}
    element[:] = [child for child in element if child.tag in children]
    for child in element:
        _drop_unread(child)


def _check_required(xml: ElementTree.Element, file: Path) -> None:
    required = [(xml, kind, attribute) for kind, attribute in (("link", "name"), ("joint", "name"), ("joint", "type"))]
    for joint in xml.findall("joint"):
        name = joint.get("name")
        required += [(joint, "parent", "link"), (joint, "child", "link")]
        for kind in ("parent", "child"):
            if joint.find(kind) is None:
                raise ValueError(f"{file}: joint {name!r} has no <{kind}>")
    for visual in xml.iter("visual"):
        geometry = visual.find("geometry")
        shapes = [] if geometry is None else [element.tag for element in geometry]
        if len(shapes) != 1 or shapes[0] not in _SHAPES:
            raise ValueError(
                f"{file}: a <visual> must have one <geometry> with one of {', '.join(_SHAPES)}, has {shapes}"
            )
        required += [(geometry, shapes[0], attribute) for attribute in _SHAPES[shapes[0]]]
    for parent, kind, attribute in required:
        for element in parent.findall(kind):
            if not element.get(attribute):
                raise ValueError(f"{file}: <{kind}> {element.get('name', '')!r} has no attribute {attribute!r}")


def _check_numbers(xml: ElementTree.Element, file: Path) -> None:
    for element in xml.iter():
        for attribute, counts in _NUMBERS.get(element.tag, {}).items():
            text = element.get(attribute)
            if text is None:
                continue
            try:
                values = [float(value) for value in text.split()]
            except ValueError as error:
                raise ValueError(
                    f"{file}: <{element.tag} {attribute}={text!r}> is malformed ({error}); separate numbers by blanks"
                ) from error
            if np.isnan(values).any() or (element.tag != "limit" and np.isinf(values).any()):
                raise ValueError(f"{file}: <{element.tag} {attribute}={text!r}> is NaN or infinite")
            if len(values) not in counts:
                raise ValueError(
                    f"{file}: <{element.tag} {attribute}={text!r}> has {len(values)} numbers, not {counts[0]}"
                )
            if element.tag in _SIZED and min(values) <= 0:
                raise ValueError(f"{file}: <{element.tag} {attribute}={text!r}> is not positive; a size must be")


def _link_poses(robot: yourdfpy.urdf.Robot, file: Path) -> dict[str, np.ndarray]:
    joint_above = {joint.child: joint for joint in robot.joints}
    poses: dict[str, np.ndarray] = {}
    for link in tree_order([link.name for link in robot.links], robot.joints, file):
        joint = joint_above.get(link)
        above = np.eye(4) if joint is None else poses[joint.parent]
        poses[link] = above if joint is None or joint.origin is None else above @ joint.origin
    return poses


def _joint(joint: yourdfpy.urdf.Joint, pose: np.ndarray, file: Path) -> LinkJoint:
    if joint.mimic is not None:
        raise ValueError(f"{file}: joint {joint.name!r} mimics {joint.mimic.joint!r}; mimic joints are not supported")
    if joint.type not in JOINT_TYPES:
        raise ValueError(
            f"{file}: joint {joint.name!r} has type {joint.type!r}; only {', '.join(JOINT_TYPES)} are supported"
        )
    lower, upper = -inf, inf
    if joint.limit is not None and joint.type != "continuous":
        lower, upper = joint.limit.lower or 0.0, joint.limit.upper or 0.0  # URDF: both default to zero
    return LinkJoint(
        joint.name,
        JOINT_TYPES[joint.type],
        joint.parent,
        joint.child,
        axis=pose[:3, :3] @ joint.axis,
        pivot=pose[:3, 3],
        lower=lower,
        upper=upper,
        label=f"{joint.child} {joint.name}",
    )


def _surface(
    visual: yourdfpy.urdf.Visual,
    link_pose: np.ndarray,  # [4, 4]
    file: Path,
    root: Path,
) -> trimesh.Trimesh:
    shape, scale = visual.geometry, np.ones(3)
    if shape.mesh is not None:
        mesh = load_mesh(_mesh_path(shape.mesh.filename, file, root))
        scale = scale if shape.mesh.scale is None else scale * shape.mesh.scale
    elif shape.box is not None:
        mesh = trimesh.creation.box(shape.box.size)
    elif shape.cylinder is not None:
        mesh = trimesh.creation.cylinder(shape.cylinder.radius, shape.cylinder.length)
    else:
        mesh = trimesh.creation.icosphere(radius=shape.sphere.radius)
    origin = np.eye(4) if visual.origin is None else visual.origin
    return transformed(mesh, link_pose @ origin @ np.diag([*scale, 1.0]))


def _mesh_path(filename: str, file: Path, root: Path) -> Path:
    scheme, separator, path = filename.partition("://")
    if not separator:
        return resolve_inside(filename, file.parent, root, file)
    if scheme != "package":
        raise ValueError(f"{file}: mesh {filename!r} is not a file path; state it relative to the URDF")
    relative = path.partition("/")[2]
    for folder in (file.parent, *file.parent.parents):
        for reference in (path, relative):
            if (candidate := resolve_inside(reference, folder, root, file)).is_file():
                return candidate
        if folder == root:
            break
    raise ValueError(f"{file}: mesh {filename!r} is missing; looked for {relative!r} from the URDF up to {root}")
