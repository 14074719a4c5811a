"""Where articulated objects come from: five sources behind one interface."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Protocol

from render.articulated_object import ArticulatedObject
from render.category import CategorySpec

SOURCES = {name: f"render.sources.{name.replace('-', '_')}" for name in (
    "procedural", "urdf", "partnet-mobility", "shape2motion", "hoi4d",
)}  # fmt: skip


class Source(Protocol):
    """A collection of instances of one category.

    Convention:
        Objects arrive in the canonical object frame of `render.category` with the category's parts and joints, in its
        order; meshes may be stored at any joint coordinate, `Joint.rest` says which.
    """

    def instance_ids(self) -> list[str]:
        """Ids of all instances, in a fixed order."""

    def left_out(self) -> dict[str, str]:
        """Why, by id, objects of the category's kind are no instances of it: a safe with two doors, for example."""
        return {}

    def load(self, instance_id: str) -> ArticulatedObject:
        """The instance; the same object for every call.

        Raises:
            ValueError: naming the file, what is wrong with it and what to do.
        """


def left_out_lines(
    left_out: dict[str, str],  # reason by id
) -> list[str]:
    """One line to read for every reason."""
    ids: dict[str, list[str]] = {}
    for instance_id, reason in left_out.items():
        ids.setdefault(reason, []).append(instance_id)
    return [f"left out {len(ids[reason])} object(s), {reason}: {', '.join(ids[reason])}" for reason in ids]


def open_source(name: str, spec: CategorySpec, root: Path | None, seed: int) -> Source:
    """Open a source.

    Args:
        name: One of `SOURCES`.
        spec: The category to make instances of.
        root: Folder of the data set; None for the procedural source.
        seed: Of the procedural designs; other sources ignore it.

    Raises:
        ValueError: if the source is unknown, cannot make the variant, or `root` does not hold a data set of its kind.
    """
    if name not in SOURCES:
        raise ValueError(f"unknown source {name!r}; choose one of {', '.join(SOURCES)}")
    if spec.variant is not None and name != "procedural":
        raise ValueError(
            f"variant {spec.variant!r} is one of procedural designs; source {name!r} has none, leave it out"
        )
    return import_module(SOURCES[name]).open(spec, root, seed)
