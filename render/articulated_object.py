"""The one model of an articulated object that every source produces and every generator step consumes."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
import trimesh

from articulate_ssl.geometry.kinematic_chain import forward_kinematics
from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE, screw_motion


@dataclass(frozen=True)
class Joint:
    """A revolute or prismatic joint between two parts, stated in the object frame at rest.

    Attributes:
        name: Unique within the object.
        type: `REVOLUTE` or `PRISMATIC` (of `articulate_ssl.geometry.screw`).
        parent: Index of the part nearer to the base.
        child: Index of the part that this joint moves.
        axis: [3] unit direction. Revolute: right-hand rule.
        pivot: [3] a point on the joint line (for prismatic joints, any point of the child part).
        lower: Smallest joint coordinate, radians or length.
        upper: Largest joint coordinate.
        rest: The coordinate at which the meshes are stored.
    """

    name: str
    type: int
    parent: int
    child: int
    axis: np.ndarray
    pivot: np.ndarray
    lower: float
    upper: float
    rest: float = 0.0


@dataclass(frozen=True)
class ArticulatedObject:
    """Named part meshes and a kinematic tree.

    Attributes:
        name: Instance id, unique within its source.
        category: Category name.
        part_names: K names, in the category's part order.
        meshes: K meshes in the object frame, assembled at rest.
        joints: J joints; every part but the base is the child of exactly one.
        base: Index of the part that no joint moves.
    """

    name: str
    category: str
    part_names: tuple[str, ...]
    meshes: tuple[trimesh.Trimesh, ...]
    joints: tuple[Joint, ...]
    base: int = 0

    @property
    def num_parts(self) -> int:
        """K."""
        return len(self.meshes)

    @property
    def rest_diagonal(self) -> float:
        """Length of the bounding-box diagonal at rest, in the units of the meshes."""
        lower = np.min([m.bounds[0] for m in self.meshes], axis=0)
        upper = np.max([m.bounds[1] for m in self.meshes], axis=0)
        return float(np.linalg.norm(upper - lower))

    @cached_property
    def part_centers(self) -> np.ndarray:  # [K, 3]
        """Bounding-box centre of every part at rest, object frame."""
        return np.array([mesh.bounds.mean(0) for mesh in self.meshes])

    def part_motion(
        self,
        states: np.ndarray,  # [J] joint coordinates
    ) -> np.ndarray:  # [K, 4, 4]
        """Motion of every part from rest to the given joint coordinates, in the object frame (float64)."""
        motions = [
            screw_motion(
                torch.as_tensor(joint.axis, dtype=torch.float64),
                torch.as_tensor(joint.pivot, dtype=torch.float64),
                torch.tensor(float(state) - joint.rest, dtype=torch.float64),
                joint.type,
            )
            for joint, state in zip(self.joints, states, strict=True)
        ]
        motion = torch.stack(motions) if motions else torch.empty(0, 4, 4, dtype=torch.float64)
        parents, children = [j.parent for j in self.joints], [j.child for j in self.joints]
        return forward_kinematics(motion, parents, children, self.num_parts).numpy()

    def at_rest(self, states: Sequence[float]) -> ArticulatedObject:
        """The same object with meshes, axes and pivots stored at other joint coordinates."""
        motion = self.part_motion(np.asarray(states))
        meshes = tuple(mesh.copy() for mesh in self.meshes)
        for mesh, matrix in zip(meshes, motion, strict=True):
            mesh.apply_transform(matrix)
        joints = tuple(
            replace(
                joint,
                rest=float(state),
                axis=motion[joint.parent, :3, :3] @ joint.axis,
                pivot=motion[joint.parent, :3, :3] @ joint.pivot + motion[joint.parent, :3, 3],
            )
            for joint, state in zip(self.joints, states, strict=True)
        )
        return replace(self, meshes=meshes, joints=joints)

    def checksum(self) -> str:
        """SHA-256 of all that clouds are made from: parts, joints and surface.

        In single precision, because the last bits of double precision may differ between machines.
        """
        joints = [(j.type, j.parent, j.child, *j.axis, *j.pivot, j.lower, j.upper, j.rest) for j in self.joints]
        digest = hashlib.sha256(repr(self.part_names).encode())
        for numbers in (joints, *(mesh.vertices for mesh in self.meshes)):
            digest.update(np.asarray(numbers, dtype="<f4").tobytes())
        for mesh in self.meshes:
            digest.update(mesh.faces.astype("<i8").tobytes())
        return digest.hexdigest()

    def validate(self) -> ArticulatedObject:
        """Return self if sound.

        Raises:
            ValueError: naming the instance and what is wrong with its meshes or its kinematic tree.
        """

        def fail(problem: str) -> None:
            raise ValueError(f"{self.category} instance {self.name!r}: {problem}")

        if len(self.part_names) != len(self.meshes):
            fail(f"{len(self.part_names)} part names but {len(self.meshes)} meshes")
        for part, mesh in zip(self.part_names, self.meshes, strict=True):
            if len(mesh.faces) == 0:
                fail(f"part {part!r} has no faces")
            if not np.isfinite(mesh.vertices).all():
                fail(f"part {part!r} has NaN or infinite vertices")
            if mesh.area <= 0:
                fail(f"part {part!r} has no surface area")
        children = [j.child for j in self.joints]
        for joint in self.joints:
            if joint.type not in (REVOLUTE, PRISMATIC):
                fail(f"joint {joint.name!r} has unknown type {joint.type}")
            if not (0 <= joint.parent < self.num_parts and 0 <= joint.child < self.num_parts):
                fail(f"joint {joint.name!r} connects parts {joint.parent} and {joint.child} of {self.num_parts}")
            values = (*joint.axis, *joint.pivot, joint.lower, joint.upper, joint.rest)
            if not np.isfinite(values).all():
                fail(f"joint {joint.name!r} has NaN or infinite axis, pivot or limits")
            if abs(np.linalg.norm(joint.axis) - 1) > 1e-6:
                fail(f"joint {joint.name!r} has an axis of length {np.linalg.norm(joint.axis):.3g}, not 1")
            if joint.lower == joint.upper:
                fail(f"joint {joint.name!r} has limits [{joint.lower}, {joint.upper}] that leave no motion")
            if joint.lower > joint.upper:
                fail(f"joint {joint.name!r} has reversed limits [{joint.lower}, {joint.upper}]")
        if sorted(children) != [k for k in range(self.num_parts) if k != self.base]:
            fail(
                f"every part but the base ({self.base}) must be the child of one joint; children are {sorted(children)}"
            )
        try:
            self.part_motion(np.array([j.rest for j in self.joints]))
        except ValueError as error:
            fail(str(error))
        return self
