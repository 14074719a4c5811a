"""Generated instances of all seven categories: no download, and any number of them.

An instance is a function of (seed, id) only, so every machine and every worker makes the same meshes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from render.articulated_object import ArticulatedObject, Joint
from render.sources.procedural import laptop
from render.sources.procedural.design import Design
from render.sources.procedural.shapes import to_trimesh

if TYPE_CHECKING:
    from render.category import CategorySpec

GENERATORS = {
    "laptop": lambda rng: laptop.build(laptop.sample_laptop(rng)),
    "laptop_real": lambda rng: laptop.build(laptop.sample_laptop_real(rng)),
}


@dataclass(frozen=True)
class ProceduralSource:
    """Instances of one category, made on demand."""

    spec: CategorySpec
    seed: int

    def instance_ids(self) -> list[str]:
        """One id per training and test instance of the category, in a fixed order."""
        return [f"{self.spec.name}-{i:04d}" for i in range(self.spec.train_instances + self.spec.test_instances)]

    def load(self, instance_id: str) -> ArticulatedObject:
        """The instance of this id, at rest."""
        entropy = [self.seed, *instance_id.encode()]
        rng = np.random.default_rng(np.random.SeedSequence(entropy))
        return assemble(GENERATORS[self.spec.name](rng), self.spec, instance_id).validate()


def open(spec: CategorySpec, root: Path | None, seed: int) -> ProceduralSource:
    """Procedural source of a category; it reads no files.

    Raises:
        ValueError: if a root folder is given, or no generator exists for the category.
    """
    if root is not None:
        raise ValueError(f"source 'procedural' reads no files, but root {root} was given; leave it out")
    if spec.name not in GENERATORS:
        raise ValueError(f"no procedural generator for category {spec.name!r}; there are {', '.join(GENERATORS)}")
    return ProceduralSource(spec, seed)


def assemble(design: Design, spec: CategorySpec, instance_id: str) -> ArticulatedObject:
    """A design, moved from joint coordinate zero to the category's rest state, with the category's articulation range."""
    names = list(design.parts)
    joints = tuple(
        Joint(
            joint.name,
            joint.type,
            names.index(joint.parent),
            names.index(joint.child),
            np.asarray(joint.axis, dtype=float),
            np.asarray(joint.pivot, dtype=float),
            joint_spec.lower,
            joint_spec.upper,
        )
        for joint, joint_spec in zip(design.joints, spec.joints, strict=True)
    )
    meshes = tuple(to_trimesh(solid) for solid in design.parts.values())
    closed = ArticulatedObject(instance_id, spec.name, tuple(names), meshes, joints)
    return at_rest(closed, np.array([joint_spec.rest for joint_spec in spec.joints]))


def at_rest(
    object: ArticulatedObject,
    rest: np.ndarray,  # [J] joint coordinates
) -> ArticulatedObject:
    """The same object with its meshes, axes and pivots stored at other joint coordinates."""
    motion = object.part_motion(rest)
    meshes = tuple(mesh.copy().apply_transform(pose) for mesh, pose in zip(object.meshes, motion, strict=True))
    joints = []
    for joint, coordinate in zip(object.joints, rest, strict=True):
        rotation, translation = motion[joint.parent][:3, :3], motion[joint.parent][:3, 3]
        moved = {"axis": rotation @ joint.axis, "pivot": rotation @ joint.pivot + translation}
        joints.append(replace(joint, **moved, rest=float(coordinate)))
    return replace(object, meshes=meshes, joints=tuple(joints))
