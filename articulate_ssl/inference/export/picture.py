"""The prediction as a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from articulate_ssl.inference.pictures.picture import draw_prediction
from articulate_ssl.inference.scan_prediction import ScanPrediction

MAX_DRAWN_POINTS = 4096


def write(result: ScanPrediction, folder: Path) -> list[Path]:
    """Write `picture.png`, of at most `MAX_DRAWN_POINTS` points of the scan, drawn with a fixed seed; return it."""
    file = folder / "picture.png"
    drawn = np.random.default_rng(0).permutation(len(result.cloud))[:MAX_DRAWN_POINTS]
    draw_prediction(result.prediction, result.cloud[drawn], result.part_id[drawn], result.limits, result.upright, file)
    return [file]
