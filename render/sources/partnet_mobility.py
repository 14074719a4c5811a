"""PartNet-Mobility (SAPIEN): one folder per object, read from its `mobility.urdf` and `semantics.txt`.

Frames: the vertices of an object share one frame, y up and z to the front, which is the canonical object frame. The
URDF turns it to z up in the fixed joint below `base`; that is undone by taking the frame of the link below.
Units are PartNet's (about the unit sphere), angles radians.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from render.articulated_object import ArticulatedObject
from render.sources import Source
from render.sources.dataset_folder import find_instances, read_json
from render.sources.part_matching import joint_groups, require_rules, to_category
from render.sources.urdf import read_urdf

if TYPE_CHECKING:
    from render.category import CategorySpec

SOURCE = "partnet-mobility"
_MOVABLE = MappingProxyType({"hinge": REVOLUTE, "slider": PRISMATIC, "slider+": PRISMATIC})


@dataclass(frozen=True)
class PartNetMobilitySource(Source):
    """Objects of the category's `model_cat` that have exactly its parts; ids are the folder names (anno ids)."""

    spec: CategorySpec
    folders: dict[str, Path]

    def instance_ids(self) -> list[str]:
        """Ids of all instances, sorted.

        Objects of another `model_cat` belong to other categories. Of the category's, those with another number of its
        parts (a safe with two doors) are other things and are left out. An object that cannot be read is taken for an
        instance: `load` says what is wrong with it.

        Raises:
            ValueError: if no object is left.
        """
        ids = self._selection[0]
        if not ids:
            groups = joint_groups(self.spec, SOURCE)
            wanted = " and ".join(f"{len(joints)} part(s) labelled {label!r}" for (_, label), joints in groups.items())
            categories = " or ".join(self.spec.recognition.rules(SOURCE)["model_cat"])
            raise ValueError(
                f"{next(iter(self.folders.values())).parent}: no matching parts, none of {len(self.folders)} objects "
                f"is of model_cat {categories} with {wanted}"
            )
        return list(ids)

    def left_out(self) -> dict[str, str]:
        """By id, how many of the category's parts the other objects of its `model_cat` have."""
        return dict(self._selection[1])

    def load(self, instance_id: str) -> ArticulatedObject:
        """The instance, stored at the URDF's zero configuration, which may lie outside the limits.

        Raises:
            ValueError: naming the file, what is wrong with it and what to do.
        """
        if problem := self._selection[2].get(instance_id):
            raise ValueError(problem)
        folder = self.folders[instance_id]
        labels = {link: label for link, _, label in read_semantics(folder / "semantics.txt")}
        graph = read_urdf(folder / "mobility.urdf", folder, below_root=True).labelled(labels)
        return to_category(graph, self.spec, SOURCE, instance_id, front_known=True)

    @cached_property
    def _selection(self) -> tuple[list[str], dict[str, str], dict[str, str]]:
        """Ids of instances, why other objects of the category's `model_cat` are none, and what cannot be read."""
        if not self.spec.parts:
            return list(self.folders), {}, {}
        ids, mismatches, problems = [], {}, {}
        for instance_id, folder in self.folders.items():
            try:
                if not self._is_of_category(folder):
                    continue
                mismatch = self._mismatch(folder)
            except ValueError as error:
                mismatch, problems[instance_id] = "", str(error)
            if mismatch:
                mismatches[instance_id] = mismatch
            else:
                ids.append(instance_id)
        return ids, mismatches, problems

    def _is_of_category(self, folder: Path) -> bool:
        meta = folder / "meta.json"
        if not meta.exists():  # some copies of the data set come without: the parts alone decide
            return True
        content = read_json(meta)
        if not isinstance(content, dict):
            raise ValueError(f"{meta}: is not a JSON object; it needs a model_cat, or delete it: the parts decide then")
        return content.get("model_cat") in self.spec.recognition.rules(SOURCE)["model_cat"]

    def _mismatch(self, folder: Path) -> str:
        """How the parts differ from the category's; empty if they do not."""
        links = read_semantics(folder / "semantics.txt")
        for (joint_type, pattern), joints in joint_groups(self.spec, SOURCE).items():
            found = sum(
                _MOVABLE.get(kind) == joint_type and bool(re.search(pattern, label)) for _, kind, label in links
            )
            if found != len(joints):
                return f"{found} movable part(s) labelled {pattern!r} instead of {len(joints)}"
        return ""


def open(spec: CategorySpec, root: Path | None, seed: int) -> PartNetMobilitySource:
    """Source of the object folders in `root`; `seed` is not used.

    Raises:
        ValueError: if the category is not in the data set or `root` holds no object.
    """
    require_rules(spec, SOURCE)
    return PartNetMobilitySource(spec, find_instances(root, "mobility.urdf"))


def read_semantics(file: Path) -> list[tuple[str, str, str]]:
    """Link name, joint type and part label of every line of a `semantics.txt`.

    Raises:
        ValueError: naming the file, if it is missing or a line is not of this form.
    """
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError) as error:
        raise ValueError(f"{file}: missing or unreadable ({error})") from error
    links = [tuple(line.split(maxsplit=2)) for line in lines if line.strip()]
    if bad := next((line for line in links if len(line) != 3), None):
        raise ValueError(f"{file}: line {' '.join(bad)!r} is not '<link> <joint type> <part label>'")
    return links
