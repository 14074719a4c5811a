"""Category specifications: everything the generator knows about a category, as data in `render/categories/*.yaml`.

Convention:
    The canonical object frame has y up, z to the front (the side a user faces) and x to the user's right.
    Revolute joints of every source open with growing coordinate: 0 is closed for doors and lids, unfolded for legs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import resources
from math import radians
from typing import Any

import yaml

from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from render.articulated_object import ArticulatedObject, Joint


@dataclass(frozen=True)
class JointSpec:
    """A joint that every instance of the category has.

    Attributes:
        name: Unique within the category.
        type: `REVOLUTE` or `PRISMATIC`.
        parent: Index of the part nearer to the base.
        child: Index of the part that this joint moves.
        lower: Smallest sampled coordinate: radians, or for prismatic joints a share of its own travel in [0, 1].
        upper: End of the sampled range (exclusive), in the unit of `lower`.
        rest: Coordinate of the canonical rest state, in the unit of `lower`.
    """

    name: str
    type: int
    parent: int
    child: int
    lower: float
    upper: float
    rest: float

    def coordinate(self, value: float, joint: Joint) -> float:
        """The coordinate of an instance's joint (radians or metric) for a value in the unit of `lower`."""
        return value if self.type == REVOLUTE else joint.lower + value * (joint.upper - joint.lower)


@dataclass(frozen=True)
class ViewSpec:
    """From where a partial view is taken: ranges in radians, relative to the object's front.

    Attributes:
        azimuth: About the object's up axis; positive looks from the user's right.
        elevation: Above the horizon.
        roll: About the viewing direction.
        resolution: Default width and height of the depth image, pixels.
    """

    azimuth: tuple[float, float]
    elevation: tuple[float, float]
    roll: tuple[float, float]
    resolution: int


@dataclass(frozen=True)
class RecognitionSpec:
    """How sources that read data sets recognise the category in a foreign object (`render.sources.part_matching`).

    Attributes:
        zero: `smallest` or `largest`: the bounding box at joint coordinate 0, compared with the end of the motion.
        front: `opening` if the front is the side to which the parts move, `opposite` if it is the other side.
        order: Direction in the object frame along which joints that look the same are numbered.
        sources: Options by source name: folder names, labels of the parts, and the like.
    """

    zero: str
    front: str
    order: tuple[float, float, float]
    sources: Mapping[str, Mapping[str, Any]]

    def rules(self, source: str) -> Mapping[str, Any]:
        """Options of one source; none if the category states none."""
        return self.sources.get(source, {})


@dataclass(frozen=True)
class CategorySpec:
    """A category.

    Attributes:
        name: For example `laptop`.
        parts: K part names; the first is the base, `part_id` follows this order.
        joints: J joints.
        train_instances: Default number of training instances.
        test_instances: Default number of test instances.
        view: Range of partial views.
        min_visible_points: Fewest points of a stored partial cloud that every part must have.
        recognition: How to find the category's parts in foreign objects; None for `articulated`, whose `parts` and
            `joints` are empty because it takes every object as it is.
        variants: Options of the procedural design by the name of a variant of the category.
        variant: The variant that this is; None for the category itself.
    """

    name: str
    parts: tuple[str, ...]
    joints: tuple[JointSpec, ...]
    train_instances: int
    test_instances: int
    view: ViewSpec
    min_visible_points: int
    recognition: RecognitionSpec | None = None
    variants: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    variant: str | None = None

    @property
    def design_options(self) -> Mapping[str, Any]:
        """Options of the procedural design: those of the variant."""
        return self.variants[self.variant] if self.variant else {}

    def of(self, instance: ArticulatedObject) -> CategorySpec:
        """The specification itself; for `articulated`, one with the parts of the instance and its joints' limits."""
        if self.parts:
            return self
        joints = tuple(
            JointSpec(j.name, j.type, j.parent, j.child, j.lower, j.upper, j.rest)
            if j.type == REVOLUTE
            else JointSpec(j.name, j.type, j.parent, j.child, 0, 1, (j.rest - j.lower) / (j.upper - j.lower))
            for j in instance.joints
        )
        return replace(self, parts=instance.part_names, joints=joints)

    def sampled_ranges(self, instance: ArticulatedObject) -> list[tuple[float, float]]:
        """Range of states to sample for every joint of an instance: the category's range within the joint's limits.

        Raises:
            ValueError: if a joint's limits exclude the whole range.
        """
        ranges = []
        for spec, joint in zip(self.of(instance).joints, instance.joints, strict=True):
            lower, upper = (spec.coordinate(value, joint) for value in (spec.lower, spec.upper))
            clipped = max(lower, joint.lower), min(upper, joint.upper)
            if clipped[0] > clipped[1]:
                raise ValueError(
                    f"{self.name} instance {instance.name!r}: joint {joint.name!r} has limits [{joint.lower:.4g}, "
                    f"{joint.upper:.4g}], which exclude the category's range [{lower:.4g}, {upper:.4g})"
                )
            ranges.append(clipped)
        return ranges

    def to_rest(self, instance: ArticulatedObject) -> ArticulatedObject:
        """The instance with its meshes stored in the category's rest state.

        Raises:
            ValueError: if its parts or joints are not those of the category.
        """
        own = self.of(instance)
        expected = [(s.type, s.parent, s.child) for s in own.joints]
        if instance.part_names != own.parts or [(j.type, j.parent, j.child) for j in instance.joints] != expected:
            raise ValueError(
                f"{self.name} instance {instance.name!r} has parts {instance.part_names} and joints "
                f"{[j.name for j in instance.joints]}; the category has parts {self.parts} and joints "
                f"{[s.name for s in self.joints]}, with given types, parents and children"
            )
        pairs = zip(own.joints, instance.joints, strict=True)
        return instance.at_rest([spec.coordinate(spec.rest, joint) for spec, joint in pairs])


@cache
def category_names() -> tuple[str, ...]:
    """Names of all categories."""
    files = resources.files("render.categories").iterdir()
    return tuple(sorted(f.name.removesuffix(".yaml") for f in files if f.name.endswith(".yaml")))


@cache
def load_category(name: str, variant: str | None = None) -> CategorySpec:
    """The specification of a category, or of a variant that its file names under `variants`.

    Raises:
        ValueError: if there is no such category or variant.
    """
    if name not in category_names():
        raise ValueError(f"unknown category {name!r}; choose one of {', '.join(category_names())}")
    text = (resources.files("render.categories") / f"{name}.yaml").read_text(encoding="utf-8")
    content = yaml.safe_load(text)
    variants = content.get("variants", {})
    if variant is not None and variant not in variants:
        raise ValueError(f"category {name!r} has no variant {variant!r}; it has {', '.join(variants) or 'none'}")
    parts, view = tuple(content["parts"]), content["view"]
    return CategorySpec(
        name=name,
        parts=parts,
        joints=tuple(_joint_spec(joint, parts) for joint in content["joints"]),
        train_instances=content["instances"]["train"],
        test_instances=content["instances"]["test"],
        view=ViewSpec(
            azimuth=_radians(view["azimuth_deg"]),
            elevation=_radians(view["elevation_deg"]),
            roll=_radians(view["roll_deg"]),
            resolution=view["resolution"],
        ),
        min_visible_points=content["min_visible_points"],
        recognition=RecognitionSpec(**content["recognition"]) if content["joints"] else None,
        variants=variants,
        variant=variant,
    )


def _joint_spec(joint: dict, parts: tuple[str, ...]) -> JointSpec:
    revolute = joint["type"] == "revolute"
    lower, upper = _radians(joint["range_deg"]) if revolute else joint["range_travel"]
    return JointSpec(
        name=joint["name"],
        type=REVOLUTE if revolute else PRISMATIC,
        parent=parts.index(joint["parent"]),
        child=parts.index(joint["child"]),
        lower=lower,
        upper=upper,
        rest=radians(joint["rest_deg"]) if revolute else joint["rest_travel"],
    )


def _radians(degrees: list[float]) -> tuple[float, float]:
    lower, upper = degrees
    return radians(lower), radians(upper)
