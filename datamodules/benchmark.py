"""Speed of the training loader, for `make bench`."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np

from datamodules.articulated_data_module import ArticulatedDataModule
from datamodules.manifest import SPLITS, Manifest, ShardEntry, set_folder
from datamodules.shards import SHARD_ARRAYS, write_shard

CATEGORY = "benchmark"


def loader_samples_per_s(
    num_points: int = 512,
    batch_size: int = 32,
    num_workers: int = 0,
    instances: int = 20,
    states: int = 100,
    stored_points: int = 4096,
    passes: int = 3,
) -> float:
    """Clouds per second that training receives, rotated, from shards in the page cache; the best of several passes."""
    with tempfile.TemporaryDirectory() as root:
        _write_random_set(root, instances, states, stored_points)
        module = ArticulatedDataModule(
            CATEGORY, root, num_points=num_points, batch_size=batch_size, num_workers=num_workers, val_samples=0
        )
        module.setup("fit")
        loader = module.train_dataloader()
        seconds = []
        for _ in range(passes):
            start = time.perf_counter()
            samples = sum(len(batch["sample"]) for batch in loader)
            seconds.append(time.perf_counter() - start)
        return samples / min(seconds)


def _write_random_set(root: str | Path, instances: int, states: int, points: int) -> None:
    """A set of the right format and size without meaning, one shard per instance like a generated one."""
    folder = set_folder(root, CATEGORY)
    ids = {"train": tuple(f"instance-{i}" for i in range(instances)), "test": ()}
    for split in SPLITS:
        (folder / split).mkdir(parents=True)
    sizes = {"S": states, "P": points, "K": 2, "J": 1}
    generator = np.random.default_rng(0)
    entries = []
    for i in range(instances):
        arrays = {
            name: generator.random([sizes.get(s, s) for s in spec.shape], dtype=np.float32).astype(spec.dtype)
            for name, spec in SHARD_ARRAYS.items()
        }
        arrays["instance"][:] = i
        name = f"shard-{i:05d}.npz"
        entries.append(ShardEntry(name, states, write_shard(folder / "train" / name, arrays)))
    Manifest(
        generator_version="none",
        options={},
        seed=0,
        category=CATEGORY,
        source="procedural",
        view="complete",
        protocol=None,
        part_names=("base", "lid"),
        joint_types=(0,),
        articulation_range=((0.0, 1.0),),
        instances=ids,
        rest_state={instance: (0.0,) for instance in ids["train"]},
        shards={"train": tuple(entries), "test": ()},
    ).save(folder)
