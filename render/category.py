"""Category specifications: everything the generator knows about a category, as data in `render/categories/*.yaml`.

A user's own category is such a file too; it need not say what `parse_category` has a default for.

Convention:
    The canonical object frame has y up, z to the front (the side a user faces) and x to the user's right.
    Revolute joints of every source open with growing coordinate: 0 is closed for doors and lids, unfolded for legs.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Set
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import resources
from math import degrees, radians
from pathlib import Path
from types import MappingProxyType
from typing import Any

import yaml

from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from render.articulated_object import ArticulatedObject, Joint

JOINT_TYPES = MappingProxyType({"revolute": REVOLUTE, "prismatic": PRISMATIC})

_NAME = re.compile(r"[A-Za-z0-9][\w-]*", re.ASCII)  # it becomes that of a folder
# What a user's file need not say.
_DEFAULTS = MappingProxyType(
    {
        "instances": {"train": 8000, "test": 2000},  # all there are, a fifth of them for test
        # As of laptops, from where a person sees an object in front; chosen.
        "view": {"azimuth_deg": [-60, 60], "elevation_deg": [15, 70], "roll_deg": [-15, 15], "resolution": 256},
        "min_visible_points": 100,
        "recognition": None,
        "variants": {},
    }
)


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
        recognition: How to find the category's parts in foreign objects; None for one that does not say, and for
            `articulated`, whose `parts` and `joints` are empty because it takes every object as it is.
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

    def with_hinges_within(self, lower: float, upper: float) -> CategorySpec:
        """The category with states of its revolute joints in [lower, upper), radians; its rest state stays.

        Raises:
            ValueError: if `lower` is not below `upper`; if it has no revolute joint, or takes those of every object as
                they are.
        """
        if not lower < upper:
            said = f"{degrees(lower):g} and {degrees(upper):g} degrees"
            raise ValueError(f"a hinge's states lie between two angles, the smaller one first, not {said}")
        if not any(joint.type == REVOLUTE for joint in self.joints):
            raise ValueError(f"category {self.name!r} has no hinges of its own, whose states could be others")
        joints = [replace(j, lower=lower, upper=upper) if j.type == REVOLUTE else j for j in self.joints]
        return replace(self, joints=tuple(joints))

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

    Args:
        name: Of a built-in category, or the path of a user's own `.yaml`, named as the category.
        variant: See above.

    Raises:
        ValueError: if there is no such category or variant, or its file is unsound, saying what is missing.
    """
    return parse_category(*category_text(name), variant)


def category_text(name: str) -> tuple[str, str]:
    """Name and YAML of a built-in category, or of a file.

    Raises:
        ValueError: if there is none, or its name cannot be that of a folder.
    """
    if name in category_names():
        return name, (resources.files("render.categories") / f"{name}.yaml").read_text(encoding="utf-8")
    path = Path(name)
    if path.suffix not in (".yaml", ".yml"):
        raise ValueError(
            f"unknown category {name!r}; choose one of {', '.join(category_names())}, or name the .yaml file of yours"
        )
    require_folder_name(path.stem)
    try:
        return path.stem, path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from error


def require_folder_name(name: str) -> None:
    """Raise ValueError if a category's name cannot be that of a folder."""
    if not _NAME.fullmatch(name):
        raise ValueError(f"category name {name!r}: use letters, digits, - and _ only; folders are named after it")


def made_category(num_parts: int, joint_type: str) -> str:
    """YAML of a category of which nothing is known but the number of its parts and the type of its joints."""
    parts = [f"part_{k}" for k in range(num_parts)]
    return yaml.safe_dump({"parts": parts, "joints": [{"type": joint_type} for _ in parts[1:]]}, sort_keys=False)


@cache
def parse_category(name: str, text: str, variant: str | None = None) -> CategorySpec:
    """The specification that a YAML text states.

    Needed are `parts` (the base first) and `joints` (one less, each with its `type`). What else a file may say, and
    what holds where it does not: a joint's `name` (`joint_<number>`), `parent` (the base), `child` (the next part),
    `range_deg` ([0, 90]) or `range_travel` ([0, 1]), `rest_deg` or `rest_travel` (the lower end); `instances` (a
    fifth for test), `view`, `min_visible_points`, `recognition` and `variants`, as the built-in categories have them.

    Raises:
        ValueError: naming the category and what is missing or wrong.
    """
    try:
        content = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ValueError(f"category {name!r}: its file is not YAML ({' '.join(str(error).split())})") from error
    try:
        return _specification(name, content, variant)
    except _Unsound as error:
        raise ValueError(f"category {name!r}: {error}") from error


class _Unsound(ValueError):
    """What is wrong with a category's file."""


def _specification(name: str, content: Any, variant: str | None) -> CategorySpec:
    _require_keys("its file", content, {"parts", "joints"}, set(_DEFAULTS))
    content = _DEFAULTS | content
    variants = content["variants"]
    if variant is not None and variant not in variants:
        raise ValueError(f"category {name!r} has no variant {variant!r}; it has {', '.join(variants) or 'none'}")
    parts, joints = content["parts"], content["joints"]
    for key, value in (("parts", parts), ("joints", joints)):
        if not isinstance(value, list):
            raise _Unsound(f"{key} must be a list, not {value!r}")
    parts = tuple(map(str, parts))
    if len(set(parts)) != len(parts):
        raise _Unsound(f"a part is named twice: {', '.join(parts)}")
    if parts and (len(parts) < 2 or len(joints) != len(parts) - 1):
        raise _Unsound(
            f"has {len(parts)} parts and {len(joints)} joints; it needs two parts or more, and one joint less"
        )
    view = content["view"]
    _require_keys("view", view, {"azimuth_deg", "elevation_deg", "roll_deg", "resolution"})
    _require_keys("instances", content["instances"], {"train", "test"})
    recognition = content["recognition"] if joints else None
    if recognition is not None:
        _require_keys("recognition", recognition, {"zero", "front", "order", "sources"})
    return CategorySpec(
        name=name,
        parts=parts,
        joints=tuple(_joint_spec(number, joint, parts) for number, joint in enumerate(joints)),
        train_instances=content["instances"]["train"],
        test_instances=content["instances"]["test"],
        view=ViewSpec(
            azimuth=_radians("view: azimuth_deg", view["azimuth_deg"]),
            elevation=_radians("view: elevation_deg", view["elevation_deg"]),
            roll=_radians("view: roll_deg", view["roll_deg"]),
            resolution=view["resolution"],
        ),
        min_visible_points=content["min_visible_points"],
        recognition=None if recognition is None else RecognitionSpec(**recognition),
        variants=variants,
        variant=variant,
    )


def _joint_spec(number: int, joint: Any, parts: tuple[str, ...]) -> JointSpec:
    where = f"joint {number}"
    ranges = {"range_deg", "rest_deg", "range_travel", "rest_travel"}
    _require_keys(where, joint, {"type"}, {"name", "parent", "child"} | ranges)
    if joint["type"] not in JOINT_TYPES:
        raise _Unsound(f"{where} has type {joint['type']!r}; there are {' and '.join(JOINT_TYPES)}")
    parent, child = joint.get("parent", parts[0]), joint.get("child", parts[number + 1])
    for part in (parent, child):
        if part not in parts:
            raise _Unsound(f"{where} names the part {part!r}; there are {', '.join(parts)}")
    revolute = joint["type"] == "revolute"
    unit = "deg" if revolute else "travel"
    if foreign := ranges & set(joint) - {f"range_{unit}", f"rest_{unit}"}:
        raise _Unsound(f"{where} is {joint['type']} and has {min(foreign)}; it may have range_{unit} and rest_{unit}")
    lower, upper = _range(f"{where}: range_{unit}", joint.get(f"range_{unit}", [0, 90] if revolute else [0, 1]))
    rest = _number(f"{where}: rest_{unit}", joint.get(f"rest_{unit}", lower))
    lower, upper, rest = (radians(v) if revolute else v for v in (lower, upper, rest))
    return JointSpec(
        joint.get("name", f"joint_{number}"), JOINT_TYPES[joint["type"]], *map(parts.index, (parent, child)),
        lower, upper, rest,
    )  # fmt: skip


def _require_keys(where: str, content: Any, needed: Set[str], optional: Set[str] = frozenset()) -> None:
    if not isinstance(content, dict):
        raise _Unsound(f"{where} must be a mapping of {', '.join(sorted(needed))}, not {content!r}")
    if missing := sorted(needed - set(content)):
        raise _Unsound(f"{where} lacks {', '.join(missing)}")
    if unknown := sorted(map(str, set(content) - needed - optional)):
        raise _Unsound(f"{where} has unknown {', '.join(unknown)}; known are {', '.join(sorted(needed | optional))}")


def _range(where: str, values: Any) -> tuple[float, float]:
    if not isinstance(values, list) or len(values) != 2:
        raise _Unsound(f"{where} must be [lowest, highest], not {values!r}")
    lower, upper = (_number(where, value) for value in values)
    if lower > upper:
        raise _Unsound(f"{where} must be [lowest, highest], not {values!r}")
    return lower, upper


def _number(where: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise _Unsound(f"{where} must be a number, not {value!r}")
    return value


def _radians(where: str, degrees: Any) -> tuple[float, float]:
    lower, upper = _range(where, degrees)
    return radians(lower), radians(upper)
