"""The predicted object as rigid links and joints: where the conventions of URDF, MJCF, GLB and USD are set, once.

Convention:
    There is one link per part, with the part's number. The root link's frame is the canonical object space. While all
    states are zero every other link is parallel to it, with its origin on the pivot of the joint that moves it, so that
    a joint's axis has the same coordinates in its parent's frame, its child's frame and canonical object space. A
    positive state turns counter-clockwise seen from the tip of the axis, or moves along it. `pose` of the object takes
    the root link to the scan. Lengths are in the unit of the scan, which readers of these formats take for metres, and
    so do the masses: meshes filled with `DENSITY` kilograms per cubic unit.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
import trimesh

from articulate_ssl.geometry.screw import screw_motion
from articulate_ssl.inference.articulation import canonical_object
from articulate_ssl.inference.export.apart import Motion, half_spaces, kept, trimmed
from articulate_ssl.inference.export.hollow import Slide, hollow_parents
from articulate_ssl.inference.export.part_mesh import part_mesh
from articulate_ssl.inference.pictures.part_colour import part_colour
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.inference.scan_prediction import JOINT_TYPE_NAMES, ScanPrediction
from datamodules.atomic import atomic_write

MESH_FOLDER = "meshes"
# Wood. No cloud tells what a thing is made of or whether it is hollow: chosen without a measurement.
DENSITY = 600.0
# Parts smaller than this share of the object's largest extent are cubes of that size, because simulators refuse bodies
# without volume. Only points that all but coincide make such parts: chosen without a measurement.
MIN_PART = 0.01
# Joints that have only one state get a range all the same, because simulators refuse none: radians, or a share of the
# object's largest extent. Chosen without a measurement.
MIN_RANGE = 1e-4
# More than the parts of any object here, so that all formats share the meshes of one prediction.
REMEMBERED_MESHES = 32


@dataclass(frozen=True)
class RigidLink:
    """One part as a rigid body.

    Attributes:
        name: `part_<k>`.
        origin: [3] of the link's frame, in canonical object space while all states are zero.
        mesh: Closed, in canonical object space.
        colour: [3] RGB from 0 to 1, as screens show it (sRGB).
        mass: Kilograms.
        center_of_mass: [3] in the link's frame.
        inertia: [3, 3] about the centre of mass, along the axes of the link's frame.
    """

    name: str
    origin: np.ndarray
    mesh: trimesh.Trimesh
    colour: np.ndarray
    mass: float
    center_of_mass: np.ndarray
    inertia: np.ndarray

    @property
    def vertices(self) -> np.ndarray:  # [V, 3]
        """Those of `mesh`, in the link's frame."""
        return self.mesh.vertices - self.origin


@dataclass(frozen=True)
class RigidJoint:
    """A joint that moves one link on another.

    Attributes:
        name: `joint_<j>`.
        kind: `revolute` or `prismatic`.
        parent: Number of the link that stays.
        child: Number of the link that moves.
        origin: [3] of the child's frame in the parent's, at state zero.
        axis: [3] unit, in both frames.
        lower: Lowest state, radians or length.
        upper: Highest state; above `lower`.
        state: The predicted state, within the two.
    """

    name: str
    kind: str
    parent: int
    child: int
    origin: np.ndarray
    axis: np.ndarray
    lower: float
    upper: float
    state: float

    def motion(self, state: float) -> np.ndarray:  # [4, 4]
        """Pose of the child's frame in the parent's."""
        kind = JOINT_TYPE_NAMES.index(self.kind)
        axis, angle = torch.from_numpy(self.axis), torch.tensor(state, dtype=torch.float64)
        pose = screw_motion(axis, torch.zeros_like(axis), angle, kind).numpy()
        pose[:3, 3] += self.origin
        return pose


@dataclass(frozen=True)
class RigidObject:
    """Links and joints of one prediction (see the module's convention).

    Attributes:
        name: The category.
        pose: [4, 4] root link -> scan.
        root: Number of the root link.
        links: K of them.
        joints: K - 1 of them, in the order of the prediction.
        upright: Whether the scan is taken to have the axes of an upright camera (x right, y down, z forward).
    """

    name: str
    pose: np.ndarray
    root: int
    links: tuple[RigidLink, ...]
    joints: tuple[RigidJoint, ...]
    upright: bool

    def joints_of(self, link: int) -> list[RigidJoint]:
        """The joints whose parent is this link."""
        return [joint for joint in self.joints if joint.parent == link]

    def link_poses(self) -> np.ndarray:  # [K, 4, 4]
        """Every link's frame in the root link's, at the predicted states."""
        poses = np.tile(np.eye(4), (len(self.links), 1, 1))
        waiting = [self.root]
        while waiting:
            for joint in self.joints_of(waiting.pop()):
                poses[joint.child] = poses[joint.parent] @ joint.motion(joint.state)
                waiting.append(joint.child)
        return poses


def rigid_object(result: ScanPrediction) -> RigidObject:
    """Links and joints of a prediction; limits are widened to hold the predicted states.

    Parts that move side by side do not meet (`apart`), and what slides through a part is cut out of it (`hollow`).
    """
    prediction = result.prediction
    child = prediction.joint_child[0].tolist()
    origin = np.zeros((prediction.num_parts, 3))
    origin[child] = prediction.canonical_pivot[0].numpy()
    shapes = canonical_object(prediction)[0].double().numpy()
    extent = float(np.ptp(shapes, axis=(0, 1)).max())
    joints = tuple(
        _joint(prediction, j, origin, limits, extent) for j, limits in enumerate(result.limits.double().numpy())
    )
    slides = [Slide(j.parent, j.child, j.axis, j.lower, j.upper) for j in joints if j.kind == "prismatic"]
    motions = [Motion(j.parent, j.child, j.axis, j.kind == "revolute") for j in joints]
    meshes = []
    for shape, spaces in zip(shapes, half_spaces(shapes, motions), strict=True):
        mesh = _with_substance(_remembered_mesh(kept(shape, spaces).tobytes()), MIN_PART * extent)
        meshes.append(trimmed(mesh, spaces))
    meshes = hollow_parents(meshes, slides)
    return RigidObject(
        name=result.category,
        pose=prediction.base_pose[0].double().numpy(),
        root=next(k for k in range(prediction.num_parts) if k not in child),
        links=tuple(_link(k, mesh, origin[k]) for k, mesh in enumerate(meshes)),
        joints=joints,
        upright=result.upright,
    )


def write_meshes(thing: RigidObject, folder: Path) -> list[Path]:
    """Write `part_<k>.stl` for every link into a folder, which is made if missing; in canonical object space."""
    folder.mkdir(exist_ok=True)
    files = [folder / f"{link.name}.stl" for link in thing.links]
    for file, link in zip(files, thing.links, strict=True):
        with atomic_write(file) as opened:
            opened.write(link.mesh.export(file_type="stl"))
    return files


@lru_cache(maxsize=REMEMBERED_MESHES)
def _remembered_mesh(
    points: bytes,  # [M, 3] float64
) -> trimesh.Trimesh:
    return part_mesh(np.frombuffer(points).reshape(-1, 3))


def _with_substance(mesh: trimesh.Trimesh, least: float) -> trimesh.Trimesh:
    """A copy, or a cube in its place if it is smaller than `least`."""
    if mesh.extents.max() >= least:
        return mesh.copy()
    return trimesh.creation.box((least,) * 3, trimesh.transformations.translation_matrix(mesh.bounds.mean(axis=0)))


def _link(
    part: int,
    mesh: trimesh.Trimesh,  # canonical object space
    origin: np.ndarray,  # [3]
) -> RigidLink:
    # At unit size, which is what trimesh's tolerances are made for.
    unit = float(np.abs(mesh.bounds).max())
    properties = trimesh.triangles.mass_properties(mesh.triangles / unit, density=DENSITY)
    return RigidLink(
        name=f"part_{part}",
        origin=origin,
        mesh=mesh,
        colour=part_colour(part) / 255,
        mass=float(properties.mass) * unit**3,
        center_of_mass=np.asarray(properties.center_mass) * unit - origin,
        inertia=np.asarray(properties.inertia + properties.inertia.T) / 2 * unit**5,
    )


def _joint(
    prediction: Prediction,  # B = 1
    joint: int,
    origin: np.ndarray,  # [K, 3] of the links, in canonical object space
    limits: np.ndarray,  # [2]
    extent: float,
) -> RigidJoint:
    parent, child = int(prediction.joint_parent[0, joint]), int(prediction.joint_child[0, joint])
    kind = JOINT_TYPE_NAMES[prediction.joint_type[0, joint]]
    state = float(prediction.joint_state[0, joint])
    lower, upper = min(limits[0], state), max(limits[1], state)
    missing = max(0.0, MIN_RANGE * (extent if kind == "prismatic" else 1.0) - (upper - lower))
    axis = prediction.canonical_axis[0, joint].double().numpy()
    return RigidJoint(
        name=f"joint_{joint}",
        kind=kind,
        parent=parent,
        child=child,
        origin=origin[child] - origin[parent],
        axis=axis / np.linalg.norm(axis),
        lower=float(lower - missing / 2),
        upper=float(upper + missing / 2),
        state=state,
    )
