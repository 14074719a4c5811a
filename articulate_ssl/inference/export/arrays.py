"""The prediction as arrays: all of it, to be looked at later (`articulate-ssl view`) or read by numpy.

Convention of `prediction.npz` (format 1):
    `prediction.<field>` and `rival.<field>` are the fields of `Prediction` (B = 1), the others those of
    `ScanPrediction`: lengths in the units of the scan, angles in radians. What is None has no entry. Nothing is
    pickled.
"""

from __future__ import annotations

import os
from dataclasses import MISSING, fields
from pathlib import Path

import numpy as np
import torch

from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.inference.scan_prediction import ScanPrediction
from datamodules.atomic import atomic_write

FILE_NAME = "prediction.npz"
FORMAT = 1
PREDICTIONS = ("prediction", "rival")
# All but parts of the points that were read of a scan: `ScanPrediction.part_id` are those of all its points.
_SAVED = tuple(field.name for field in fields(Prediction) if field.name != "dense_part_id")


class ResultFolderError(ValueError):
    """A folder holds no prediction that can be read; the message names the file and the remedy."""


def write(result: ScanPrediction, folder: Path) -> list[Path]:
    """Write `prediction.npz`; return it."""
    file = folder / FILE_NAME
    entries = {"format": np.array(FORMAT)}
    for field in fields(result):
        value = getattr(result, field.name)
        if isinstance(value, Prediction):
            entries |= {f"{field.name}.{name}": getattr(value, name).numpy() for name in _SAVED}
        elif value is not None:
            entries[field.name] = np.asarray(value)
    with atomic_write(file) as opened:
        np.savez_compressed(opened, **entries)
    return [file]


def load_scan_prediction(folder: str | os.PathLike) -> ScanPrediction:
    """What `write` wrote into a folder of results.

    Raises:
        ResultFolderError: if the file is missing, damaged, of another program or of another version of this one.
    """
    file = Path(folder) / FILE_NAME
    if not file.is_file():
        raise ResultFolderError(
            f"{folder}: holds no {FILE_NAME}; name a folder that `articulate-ssl predict SCAN --out {folder}` wrote"
        )
    try:
        with np.load(file, allow_pickle=False) as opened:
            entries = dict(opened)
    except Exception as error:  # damaged headers are parsed as Python, damaged archives by zlib: each fails in its way
        raise ResultFolderError(f"{file}: damaged, or no file of ours ({error}); predict the scan again") from error
    if not np.array_equal(entries.pop("format", None), FORMAT):
        raise ResultFolderError(f"{file}: not of format {FORMAT}; predict the scan again with this version")
    return _read(entries, file)


def _read(entries: dict[str, np.ndarray], file: Path) -> ScanPrediction:
    values = {}
    for field in fields(ScanPrediction):
        if field.name in PREDICTIONS and any(name.startswith(f"{field.name}.") for name in entries):
            names = {name: f"{field.name}.{name}" for name in _SAVED}
            _check_names(names.values(), entries, file)
            values[field.name] = Prediction(**{f: torch.from_numpy(entries[name]) for f, name in names.items()})
        elif field.name in entries:
            entry = entries[field.name]
            values[field.name] = entry.item() if entry.ndim == 0 else entry
    required = [field.name for field in fields(ScanPrediction) if field.default is MISSING]
    _check_names(required, {"checkpoint": None} | values, file)
    values["limits"] = torch.from_numpy(values["limits"])
    return ScanPrediction(**{"checkpoint": None} | values)


def _check_names(needed, found, file: Path) -> None:
    missing = [name for name in needed if name not in found]
    if missing:
        raise ResultFolderError(f"{file}: lacks {', '.join(missing)}; predict the scan again")
