"""The synthetic set as scans that nobody labelled."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from datamodules.manifest import SPLITS, Manifest
from datamodules.shards import UNLABELLED_ARRAYS, read_shard, write_shard


def without_labels(folder: Path, split_by: str = "instance") -> Path:
    """Take the labels out of a set's shards and manifest."""
    manifest = Manifest.load(folder)
    shards, scans = {}, {}
    for split in SPLITS:
        entries, files = [], []
        for entry in manifest.shards[split]:
            path = folder / split / entry.name
            arrays = {name: array.copy() for name, array in read_shard(path).items() if name in UNLABELLED_ARRAYS}
            path.unlink()
            entries.append(replace(entry, sha256=write_shard(path, arrays)))
            copies = manifest.options["rotations"] if split == "test" else 1
            files += [f"{entry.name}/{row}.ply" for row in range(entry.samples // copies)]
        shards[split], scans[split] = tuple(entries), tuple(files)
    replace(
        manifest, labelled=False, rest_state={}, articulation_range=(), shards=shards, scans=scans, split_by=split_by
    ).save(folder)
    return folder
