"""Generated instances of all categories: no download, and any number of them.

An instance is a function of seed, id and the category's variant only, so every machine and every worker makes the same
meshes.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from render.articulated_object import ArticulatedObject
from render.category import CategorySpec
from render.seeds import generator_for
from render.sources import Source
from render.sources.procedural import (
    desk_lamp,
    drawer,
    eyeglasses,
    laptop,
    laptop_parameters,
    oven,
    safe,
    washing_machine,
)
from render.sources.procedural.shapes import to_trimesh

# How to draw an instance's parameters, and how to build its solids from them.
GENERATORS = {
    "desk_lamp": (desk_lamp.sample, desk_lamp.build),
    "drawer": (drawer.sample, drawer.build),
    "eyeglasses": (eyeglasses.sample, eyeglasses.build),
    "laptop": (laptop_parameters.sample_laptop, laptop.build),
    "laptop_real": (laptop_parameters.sample_laptop_real, laptop.build),
    "oven": (oven.sample, oven.build),
    "safe": (safe.sample, safe.build),
    "washing_machine": (washing_machine.sample, washing_machine.build),
}
NUM_INSTANCES = 10_000  # that have an id; they are made when they are loaded


@dataclass(frozen=True)
class ProceduralSource(Source):
    """Instances of one category, made on demand."""

    spec: CategorySpec
    seed: int

    def instance_ids(self) -> list[str]:
        """Ids of far more instances than a category's default split needs, in a fixed order."""
        return [f"{self.spec.name}-{i:04d}" for i in range(NUM_INSTANCES)]

    def load(self, instance_id: str) -> ArticulatedObject:
        """The instance of this id, closed (or unfolded), in metres.

        Raises:
            ValueError: if there is no such instance.
        """
        if instance_id not in self.instance_ids():
            known = f"{self.spec.name}-0000 to {self.spec.name}-{NUM_INSTANCES - 1}"
            raise ValueError(f"no procedural instance {instance_id!r} of {self.spec.name}; there are {known}")
        sample, build = GENERATORS[self.spec.name]
        design = build(sample(generator_for(self.seed, "design", instance_id), **self.spec.design_options))
        meshes = tuple(to_trimesh(solid) for solid in design.parts.values())
        return ArticulatedObject(instance_id, self.spec.name, tuple(design.parts), meshes, design.joints).validate()


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
