"""Hand a prediction over in the frame and the units of the user's scan: clouds, models of it, a picture, JSON."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from articulate_ssl.inference.export import (
    animation,
    arrays,
    coloured_clouds,
    glb,
    mjcf,
    picture,
    prediction_json,
    urdf,
    usd,
)
from articulate_ssl.inference.export.rigid_links import MESH_FOLDER
from articulate_ssl.inference.scan_prediction import ScanPrediction

Exporter = Callable[[ScanPrediction, Path], list[Path]]

# The JSON stays last: where it is new, the rest is.
EXPORTERS_BY_NAME: dict[str, Exporter] = {
    "clouds": coloured_clouds.write,
    "urdf": urdf.write,
    "mjcf": mjcf.write,
    "glb": glb.write,
    "usd": usd.write,
    "picture": picture.write,
    "gif": animation.write,
    "arrays": arrays.write,
    "json": prediction_json.write,
}
# Written only where asked for by name, because they take seconds.
ON_REQUEST = ("gif",)


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
    """A format is unknown, or needs a package that is not installed; the message says what to do."""


def exporters_named(names: Sequence[str] | None = None) -> tuple[Exporter, ...]:
    """The exporters of these formats, in the order of `EXPORTERS_BY_NAME`.

    Of None, all that this machine can write but those `ON_REQUEST`.

    Raises:
        ExportError: if a name is unknown, or if its format needs a package that is not installed.
    """
    if names is None:
        return tuple(write for name, write in EXPORTERS_BY_NAME.items() if name not in ON_REQUEST and _installed(name))
    unknown = [name for name in names if name not in EXPORTERS_BY_NAME]
    if unknown:
        raise ExportError(f"no export is called {', '.join(unknown)}; there are {', '.join(EXPORTERS_BY_NAME)}")
    for name in names:
        if not _installed(name):
            extra = EXTRAS[name]
            raise ExportError(
                f"the export {name} needs the package {extra.package}, which is not installed; "
                f"pip install 'articulate-ssl[{extra.name}]'"
            )
    return tuple(write for name, write in EXPORTERS_BY_NAME.items() if name in names)


def _installed(name: str) -> bool:
    return name not in EXTRAS or find_spec(EXTRAS[name].package) is not None


EXPORTERS = exporters_named()


def write_prediction(
    result: ScanPrediction,
    folder: Path,
    exporters: Sequence[Exporter] = EXPORTERS,
) -> list[Path]:
    """Write all that `exporters` write, in their order, into a folder, which is made if missing.

    Every file is replaced whole or not at all, and nothing else in the folder is touched. Folders are made before the
    first file: where one cannot be made, nothing is written.

    Returns:
        The files written, each once.

    Raises:
        OSError: if a folder cannot be made or a file cannot be written.
    """
    with_meshes = {urdf.write, mjcf.write} & set(exporters)
    (folder / MESH_FOLDER if with_meshes else folder).mkdir(parents=True, exist_ok=True)
    return list(dict.fromkeys(file for write in exporters for file in write(result, folder)))
