"""The names of what `folder` can write, which of it this machine can, and where: nothing else is imported for that."""

from __future__ import annotations

import os
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

# The JSON stays last: where it is new, the rest is.
FORMATS = ("clouds", "urdf", "mjcf", "glb", "usd", "picture", "gif", "arrays", "json")
# Written only where asked for by name, because they take seconds.
ON_REQUEST = ("gif",)
MODELS = ("urdf", "mjcf")  # what the physics check reads


class Extra(NamedTuple):
    """A package that only one format needs.

    Attributes:
        package: As Python imports it.
        name: The extra of this distribution that installs it.
    """

    package: str
    name: str


EXTRAS = {"usd": Extra("pxr", "usd")}


class ExportError(ValueError):
    """What is asked for cannot be written, or not there; the message says what to do."""


def chosen_formats(names: Sequence[str] | None = None) -> tuple[str, ...]:
    """These formats, in the order of `FORMATS`; of None, all that this machine can write but those `ON_REQUEST`.

    Raises:
        ExportError: if a name is unknown, or if its format needs a package that is not installed.
    """
    if names is None:
        return tuple(name for name in FORMATS if name not in ON_REQUEST and _installed(name))
    unknown = [name for name in names if name not in FORMATS]
    if unknown:
        raise ExportError(f"no export is called {', '.join(unknown)}; there are {', '.join(FORMATS)}")
    for name in names:
        if not _installed(name):
            extra = EXTRAS[name]
            raise ExportError(
                f"the export {name} needs the package {extra.package}, which is not installed; "
                f"pip install 'articulate-ssl[{extra.name}]'"
            )
    return tuple(name for name in FORMATS if name in names)


def demand_folder(folder: Path) -> None:
    """Refuse a folder that can neither be written into nor made, before work is done for it; it is not made here.

    Raises:
        ExportError: naming the folder.
    """
    wanted = folder.absolute()
    there = next(path for path in (wanted, *wanted.parents) if path.exists())
    if not there.is_dir():
        raise ExportError(f"{folder}: no folder for results, as {there} is a file; name another folder")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ExportError(f"{folder}: no folder for results, as {there} may not be written into; name another folder")


def _installed(name: str) -> bool:
    return name not in EXTRAS or find_spec(EXTRAS[name].package) is not None
