"""The synthetic set with occupancy samples: its clouds fill solid boxes, so their own points are inside."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from synthetic import write_synthetic_set

from datamodules.manifest import Manifest
from datamodules.occupancy import OccupancyEntry, OccupancyIndex, samples_path, write_samples

POINTS = 64


def write_occupied_set(root: str | Path) -> Path:
    """Write the set with `POINTS` samples of every training cloud and return its folder.

    Samples alternate: one of the cloud's first points, which is inside, and one far from it, which is not.
    """
    folder = write_synthetic_set(root)
    rng = np.random.default_rng(0)
    entries = []
    for shard in Manifest.load(folder).shards["train"]:
        points = np.load(folder / "train" / shard.name)["points"][:, :POINTS].copy()
        direction = rng.normal(size=(len(points), POINTS // 2, 3))
        points[:, 1::2] = 0.9 * direction / np.linalg.norm(direction, axis=-1, keepdims=True)
        inside = np.broadcast_to(np.arange(POINTS) % 2 == 0, points.shape[:2])
        sha256 = write_samples(samples_path(folder, "train", shard.name), points, inside)
        entries.append(OccupancyEntry("train", shard.name, shard.sha256, sha256))
    OccupancyIndex(POINTS, 0.0, tuple(entries)).save(folder)
    return folder
