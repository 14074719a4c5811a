"""The clouds of a shard as scans: `python -m datamodules.scans SHARD OUT`.

A scan is what a user has and what `articulate-ssl predict`, `articulate-ssl twin` and `make data SOURCE=clouds` read:
one cloud per file, in the units of the source and without normalisation or labels. Files are called
`<shard>-<sample>`, so that several shards can be written into one folder. Exit code 0, or 2 for a shard that cannot be
read or a folder that cannot be written, with one message.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
import trimesh
from rich.console import Console
from rich.progress import track

from datamodules.atomic import atomic_write
from datamodules.shards import ShardError, read_shard


def write_scans(
    shard: str | os.PathLike,
    folder: str | os.PathLike,
    suffix: str = ".npy",
    progress: Callable[[Sequence], Iterator] = iter,
) -> list[Path]:
    """Write every sample of a shard as one scan: `points * scale + center`, in camera space, float32.

    Args:
        shard: Labelled or not.
        folder: Is made if missing; files of the same names are replaced.
        suffix: One of `WRITERS`.
        progress: Wraps the loop over the samples, for example `rich.progress.track`.

    Returns:
        The files written, in the order of the samples.

    Raises:
        ShardError: if the shard is missing, damaged or not in the shard format.
        OSError: if the folder cannot be made or a file cannot be written.
    """
    shard, folder = Path(shard), Path(folder)
    arrays = read_shard(shard)
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for sample in progress(range(len(arrays["scale"]))):
        points = arrays["points"][sample].astype(np.float64) * arrays["scale"][sample] + arrays["center"][sample]
        file = folder / f"{shard.stem}-{sample:04d}{suffix}"
        with atomic_write(file) as opened:
            WRITERS[suffix](opened, points.astype(np.float32))
        files.append(file)
    return files


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m datamodules.scans", description=__doc__.splitlines()[0])
    parser.add_argument("shard", metavar="SHARD", type=Path, help="shard-….npz of a data set")
    parser.add_argument("out", metavar="OUT", type=Path, help="folder for the scans")
    parser.add_argument("--suffix", choices=list(WRITERS), default=".npy", help="kind of file (default: .npy)")
    args = parser.parse_args(arguments)
    console = Console(stderr=True)
    try:
        files = write_scans(
            args.shard, args.out, args.suffix, lambda rows: track(rows, "Writing", console=console, transient=True)
        )
    except (ShardError, OSError) as error:
        print(f"python -m datamodules.scans: {error}", file=sys.stderr)
        return 2
    print(f"{args.out}: {len(files)} scans, {files[0].name} to {files[-1].name}")
    return 0


def _write_npy(
    file: BinaryIO,
    points: np.ndarray,  # [P, 3]
) -> None:
    np.save(file, points, allow_pickle=False)


def _write_ply(
    file: BinaryIO,
    points: np.ndarray,  # [P, 3]
) -> None:
    file.write(trimesh.PointCloud(points).export(file_type="ply"))


WRITERS = {".npy": _write_npy, ".ply": _write_ply}


if __name__ == "__main__":
    sys.exit(main())
