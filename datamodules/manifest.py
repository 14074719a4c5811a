"""The manifest: what a generated data set is, how it was made, and the checksums of its shards."""

from __future__ import annotations

import json
import math
import os
import reprlib
from dataclasses import asdict, dataclass, field, fields
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

from datamodules.atomic import atomic_write

SCHEMA_VERSION = 4
MANIFEST_NAME = "manifest.json"
SPLITS = ("train", "test")
VIEWS = ("complete", "partial")
PROTOCOLS = ("honest", "eap")
SPLIT_BY = ("instance", "scan")
# Fields that older versions did not have, and what they mean there.
_ADDED = {
    1: {"left_out": {}},
    2: {"labelled": True, "split_by": "instance", "scans": {"train": [], "test": []}},
    3: {"checksums": {}},
}


class ManifestError(ValueError):
    """A manifest is missing, damaged or of another schema version; the message names the file and the remedy."""


@dataclass(frozen=True)
class ShardEntry:
    """One shard of a split: file name inside the split's folder, number of samples, and checksum."""

    name: str
    samples: int
    sha256: str

    def __post_init__(self) -> None:
        """Raises ValueError if a field is of another type."""
        _check_types(self)


@dataclass(frozen=True)
class Manifest:
    """Description of one generated data set.

    Attributes:
        generator_version: Version of the package that made the set.
        options: Every option of the generator.
        seed: Seed of the generator.
        category: Category name.
        source: Where the articulated objects come from, for example `procedural`.
        view: `complete` or `partial`.
        protocol: `honest` or `eap` for partial views, None for complete clouds.
        part_names: K part names, in the order of `part_id`.
        joint_types: J joint types, 0 revolute, 1 prismatic.
        articulation_range: J pairs (lower, upper) of the sampled joint states, relative to the rest state; radians, or
            length / rest-state bounding-box diagonal. Empty if nothing is labelled.
        instances: Instance ids of each split; `instance` of the shards indexes into its split's ids.
        rest_state: J joint coordinates at rest of every instance id; radians, or length in the units of the source
            (divide by `scale` of a sample to compare with its `joint_state`). Empty if nothing is labelled.
        shards: Shards of each split, in the order of the global sample index.
        rejected_views: Views that were drawn again because a part showed too few points.
        left_out: Why, by id, objects (or scans) of the source are not in the set.
        labelled: Whether the shards have labels. Where they have none, parts and joints are what the user says.
        split_by: `instance`: no object is in both splits; `scan`: there is one object, some of whose scans test.
        scans: Where nothing is labelled, the files of each split in the order of its samples, below the root folder;
            each gives `options["rotations"]` samples of a complete test split, else one.
        checksums: SHA-256 of every file in `scans`, or of every external object as it was read, by path or id. Empty
            of procedural objects and of sets that were made before version 4.
        schema_version: Version of this file's format.
    """

    generator_version: str
    options: dict[str, Any]
    seed: int
    category: str
    source: str
    view: str
    protocol: str | None
    part_names: tuple[str, ...]
    joint_types: tuple[int, ...]
    articulation_range: tuple[tuple[float, float], ...]
    instances: dict[str, tuple[str, ...]]
    rest_state: dict[str, tuple[float, ...]]
    shards: dict[str, tuple[ShardEntry, ...]]
    rejected_views: int = 0
    left_out: dict[str, str] = field(default_factory=dict)
    labelled: bool = True
    split_by: str = "instance"
    scans: dict[str, tuple[str, ...]] = field(default_factory=lambda: {split: () for split in SPLITS})
    checksums: dict[str, str] = field(default_factory=dict)
    schema_version: int = SCHEMA_VERSION

    def __post_init__(self) -> None:
        """Raises ValueError if a field is of another type, or the fields contradict each other."""
        _check_types(self)
        if self.view not in VIEWS:
            raise ValueError(f"view is {self.view!r}, expected one of {', '.join(VIEWS)}")
        protocols = PROTOCOLS if self.view == "partial" else (None,)
        if self.protocol not in protocols:
            raise ValueError(f"protocol is {self.protocol!r}, expected one of {protocols} for {self.view} views")
        if self.split_by not in SPLIT_BY:
            raise ValueError(f"split_by is {self.split_by!r}, expected one of {', '.join(SPLIT_BY)}")
        for name in ("instances", "shards", "scans"):
            if sorted(getattr(self, name)) != sorted(SPLITS):
                raise ValueError(f"{name} names the splits {sorted(getattr(self, name))}, expected {sorted(SPLITS)}")
        ids = [i for split in SPLITS for i in self.instances[split]]
        if len(set(ids)) != len(ids) and self.split_by == "instance":
            raise ValueError("an instance id appears twice; splits must not share instances")
        if both := set(ids) & set(self.left_out):
            raise ValueError(f"instance {min(both)!r} is both in a split and left out")
        if not set(self.joint_types) <= {0, 1}:
            raise ValueError(f"joint_types are {list(self.joint_types)}, expected 0 (revolute) or 1 (prismatic)")
        if self.labelled:
            self._check_labels(ids)
        if any(shard.samples < 1 for split in SPLITS for shard in self.shards[split]):
            raise ValueError("a shard has no samples")
        for split in SPLITS:
            names = [shard.name for shard in self.shards[split]]
            if len(set(names)) != len(names) or any(Path(name).name != name for name in names):
                raise ValueError(f"shard names of split {split!r} must be distinct plain file names")

    def _check_labels(self, ids: list[str]) -> None:
        if set(self.rest_state) != set(ids):
            raise ValueError("rest_state must name exactly the instances of the splits")
        num_joints = len(self.joint_types)
        if len(self.articulation_range) != num_joints or any(len(q) != num_joints for q in self.rest_state.values()):
            raise ValueError(f"articulation_range and every rest_state must have {num_joints} entries, one per joint")

    @property
    def num_parts(self) -> int:
        """K."""
        return len(self.part_names)

    def num_samples(self, split: str) -> int:
        """Number of samples of a split."""
        return sum(shard.samples for shard in self.shards[split])

    def also_in(
        self,
        other: Manifest,
        split: str,
    ) -> set[str]:
        """Ids of the objects of this set that a split of another set shows, too.

        External objects are known by their ids. Generated ones have numbers for ids, which mean the same objects only
        under the same seed and variant.
        """

        def origin(manifest: Manifest) -> tuple:
            drawn = (manifest.seed, manifest.options.get("variant")) if manifest.source == "procedural" else ()
            return manifest.category, manifest.source, *drawn

        if origin(self) != origin(other):
            return set()
        return {i for ids in self.instances.values() for i in ids} & set(other.instances[split])

    def save(self, folder: str | os.PathLike) -> None:
        """Write `manifest.json` into `folder`, atomically; equal manifests give equal bytes."""
        text = json.dumps(asdict(self), indent=2, sort_keys=True, allow_nan=False) + "\n"
        with atomic_write(Path(folder) / MANIFEST_NAME) as file:
            file.write(text.encode())

    @classmethod
    def load(cls, folder: str | os.PathLike) -> Manifest:
        """Read `manifest.json` of a data set folder.

        Raises:
            ManifestError: if it is missing, not JSON, of another schema version, or contradicts itself.
        """
        path = Path(folder) / MANIFEST_NAME
        remedy = "Remove the folder and make the set again with `make data`."
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError as error:
            raise ManifestError(f"{path}: manifest is missing. Make or complete the set with `make data`.") from error
        except ValueError as error:
            raise ManifestError(f"{path}: manifest is not valid JSON ({error}). {remedy}") from error
        if not isinstance(content, dict):
            raise ManifestError(f"{path}: manifest is not a JSON object. {remedy}")
        for version, added in _ADDED.items():
            if content.get("schema_version") == version:
                content = added | content | {"schema_version": version + 1}
        if (version := content.get("schema_version")) != SCHEMA_VERSION:
            raise ManifestError(
                f"{path}: schema version is {version!r}, this program reads version {SCHEMA_VERSION}. {remedy}"
            )
        expected = {attribute.name for attribute in fields(cls)}
        if difference := expected.symmetric_difference(content):
            kind = "missing" if difference & expected else "unknown"
            raise ManifestError(f"{path}: manifest has {kind} fields: {', '.join(sorted(difference))}. {remedy}")
        try:
            shards = {s: tuple(ShardEntry(**entry) for entry in e) for s, e in content["shards"].items()}
            as_read = {"options": content["options"], "shards": shards}
            return cls(**{name: _tuples(value) for name, value in content.items()} | as_read)
        except (ValueError, TypeError, AttributeError) as error:
            raise ManifestError(f"{path}: manifest is damaged: {error}. {remedy}") from error


@cache
def _types(kind: type) -> dict[str, Any]:
    """Types of a dataclass's fields by name."""
    return get_type_hints(kind)


def _check_types(described: Manifest | ShardEntry) -> None:
    """Raise ValueError, naming the field, if the value of one is not of its type."""
    for attribute in fields(described):
        value = getattr(described, attribute.name)
        if not _is(value, _types(type(described))[attribute.name]):
            raise ValueError(f"{attribute.name} is {reprlib.repr(value)}, expected {attribute.type}")


def _is(value: Any, kind: Any) -> bool:
    """Whether a value is of a type, as annotations of the fields above state it; a float must be finite."""
    inner = get_args(kind)
    if get_origin(kind) is dict:
        return isinstance(value, dict) and all(_is(k, inner[0]) and _is(v, inner[1]) for k, v in value.items())
    if get_origin(kind) is tuple:
        kinds = inner[:1] * len(value) if inner[-1] is ... and isinstance(value, tuple) else inner
        return isinstance(value, tuple) and len(value) == len(kinds) and all(map(_is, value, kinds))
    if get_origin(kind) is UnionType:
        return any(_is(value, one) for one in inner)
    if kind is float:
        return isinstance(value, (int, float)) and math.isfinite(value)
    return kind is Any or isinstance(value, kind)


def _tuples(value: Any) -> Any:
    """JSON lists back as the tuples they were, at any depth."""
    if isinstance(value, dict):
        return {key: _tuples(inner) for key, inner in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def set_folder(
    root: str | os.PathLike,
    category: str,
    source: str = "procedural",
    view: str = "complete",
    protocol: str | None = None,
) -> Path:
    """Folder of a data set: `<root>/<category>/<source>-<view>[-<protocol>]`."""
    return Path(root) / category / "-".join(part for part in (source, view, protocol) if part)
