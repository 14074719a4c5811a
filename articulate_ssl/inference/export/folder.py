"""Hand a prediction over in the frame and the units of the user's scan: clouds, models of it, a picture, JSON."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

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
from articulate_ssl.inference.export.formats import chosen_formats
from articulate_ssl.inference.export.rigid_links import MESH_FOLDER
from articulate_ssl.inference.scan_prediction import ScanPrediction

Exporter = Callable[[ScanPrediction, Path], list[Path]]

# In the order of `FORMATS`.
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


def exporters_named(names: Sequence[str] | None = None) -> tuple[Exporter, ...]:
    """The exporters of these formats; see `formats.chosen_formats`."""
    return tuple(EXPORTERS_BY_NAME[name] for name in chosen_formats(names))


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
