"""Occupancy samples of a set: points in space, and which of them lie in the object. They lie beside the shards.

A set's shards and manifest know nothing of them. `<set>/occupancy/<split>/<shard>.npy` is one float16 array [S, M, 4]:
M points for each of the shard's S clouds, in the frame and unit of the shard's `points`, and 1 where one is inside,
else 0. `<set>/occupancy/occupancy.json` lists these files with their checksums and those of the shards they belong to.
`render.occupancy` writes them and says how points are drawn and what inside is.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from datamodules.atomic import atomic_write
from datamodules.manifest import ShardEntry
from datamodules.shards import ShardError, sha256_of

FOLDER = "occupancy"
INDEX_NAME = "occupancy.json"
INDEX_VERSION = 1
REMEDY = "Repeat the `make data` command that made the set with ARGS='--occupancy 2048'."


class OccupancyError(ShardError):
    """Occupancy samples are missing, damaged or of another set; the message names the file and the remedy."""


@dataclass(frozen=True)
class OccupancyEntry:
    """The samples of one shard.

    Attributes:
        split: Of the shard.
        shard: Its file name.
        shard_sha256: Its checksum when the samples were drawn.
        sha256: Of the samples' own file.
    """

    split: str
    shard: str
    shard_sha256: str
    sha256: str


@dataclass(frozen=True)
class OccupancyIndex:
    """What lies in the occupancy folder of a set.

    Attributes:
        points: M.
        voxel: What is nearer to a surface than half of this is inside, too; in rest-state bounding-box diagonals.
        entries: One for every shard that has samples.
    """

    points: int
    voxel: float
    entries: tuple[OccupancyEntry, ...]

    def find(self, split: str, shard: ShardEntry) -> OccupancyEntry | None:
        """The samples of a shard of the manifest; None if it has none, or the shard is another one now."""
        own = (e for e in self.entries if (e.split, e.shard, e.shard_sha256) == (split, shard.name, shard.sha256))
        return next(own, None)

    def save(self, folder: str | os.PathLike) -> None:
        """Write it into the occupancy folder of a set, atomically."""
        content = {"version": INDEX_VERSION, **asdict(self)}
        (Path(folder) / FOLDER).mkdir(exist_ok=True)
        with atomic_write(Path(folder) / FOLDER / INDEX_NAME) as file:
            file.write((json.dumps(content, indent=2, sort_keys=True) + "\n").encode())

    @classmethod
    def load(cls, folder: str | os.PathLike) -> OccupancyIndex:
        """Of a set's folder.

        Raises:
            OccupancyError: if it is missing, damaged or of another version.
        """
        path = Path(folder) / FOLDER / INDEX_NAME
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            if (version := content.pop("version", None)) != INDEX_VERSION:
                raise ValueError(f"version is {version!r}, this program reads {INDEX_VERSION}")
            entries = tuple(OccupancyEntry(**entry) for entry in content["entries"])
            return cls(int(content["points"]), float(content["voxel"]), entries)
        except FileNotFoundError as error:
            raise OccupancyError(f"{path}: the set has no occupancy samples. {REMEDY}") from error
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise OccupancyError(f"{path}: not an index of occupancy samples ({error}). Delete it. {REMEDY}") from error


def samples_path(folder: str | os.PathLike, split: str, shard: str) -> Path:
    """Where the samples of a shard lie, e.g. `occupancy/train/shard-00000.npy`."""
    return Path(folder) / FOLDER / split / Path(shard).with_suffix(".npy").name


def write_samples(path: Path, points: np.ndarray, inside: np.ndarray) -> str:
    """Write one file atomically and return its SHA-256.

    Args:
        path: Its final name.
        points: [S, M, 3], stored as float16.
        inside: [S, M] bool.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as file:
        np.save(file, np.concatenate([points, inside[..., None]], axis=-1, dtype=np.float16), allow_pickle=False)
        file.flush()
        return sha256_of(file.name)


def open_samples(path: Path, clouds: int, points: int) -> np.ndarray:  # [S, M, 4] float16
    """One file, mapped into memory.

    Raises:
        OccupancyError: if it is missing, damaged, or has not `points` samples of each of `clouds` clouds.
    """
    try:
        samples = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise OccupancyError(f"{path}: cannot be read ({error}). Delete it. {REMEDY}") from error
    if samples.dtype != np.float16 or samples.shape != (clouds, points, 4):
        raise OccupancyError(
            f"{path}: holds {samples.dtype} {list(samples.shape)}, expected float16 {[clouds, points, 4]}. Delete it. "
            f"{REMEDY}"
        )
    return samples
