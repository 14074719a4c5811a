"""Hand a prediction over in the frame and the units of the user's scan: JSON, coloured clouds, URDF, a picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from articulate_ssl.inference.export import coloured_clouds, picture, prediction_json, urdf
from articulate_ssl.inference.scan_prediction import ScanPrediction

# The JSON stays last: where it is new, the rest is.
EXPORTERS = (coloured_clouds.write, urdf.write, picture.write, prediction_json.write)


def write_prediction(
    result: ScanPrediction,
    folder: Path,
    exporters: Sequence[Callable[[ScanPrediction, Path], list[Path]]] = EXPORTERS,
) -> list[Path]:
    """Write all that `exporters` write, in their order, into a folder, which is made if missing.

    Every file is replaced whole or not at all, and nothing else in the folder is touched. Folders are made before the
    first file: where one cannot be made, nothing is written.

    Returns:
        The files written.

    Raises:
        OSError: if a folder cannot be made or a file cannot be written.
    """
    (folder / urdf.MESH_FOLDER).mkdir(parents=True, exist_ok=True)
    return [file for write in exporters for file in write(result, folder)]
