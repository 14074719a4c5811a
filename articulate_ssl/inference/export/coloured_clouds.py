"""The scan and its reconstruction as clouds that are coloured by part."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from articulate_ssl.inference.articulation import posed_parts
from articulate_ssl.inference.pictures.part_colour import part_colour
from articulate_ssl.inference.point_cloud_io import save_coloured_ply
from articulate_ssl.inference.scan_prediction import ScanPrediction


def write(result: ScanPrediction, folder: Path) -> list[Path]:
    """Write `parts.ply`, the whole scan, and `reconstruction.ply`, the posed part shapes; return the two."""
    files = [folder / "parts.ply", folder / "reconstruction.ply"]
    save_coloured_ply(files[0], result.cloud, part_colour(result.part_id))
    shapes = posed_parts(result.prediction)[0]
    colours = part_colour(np.arange(result.prediction.num_parts))
    save_coloured_ply(files[1], shapes.reshape(-1, 3).numpy(), np.repeat(colours, shapes.shape[1], axis=0))
    return files
