"""One split of a generated set, fetched a whole batch at a time."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import roma
import torch
from torch import Tensor
from torch.utils.data import Dataset

from articulate_ssl.geometry.se3 import se3
from datamodules.manifest import Manifest, ShardEntry
from datamodules.occupancy import REMEDY, OccupancyError, OccupancyIndex, open_samples, samples_path
from datamodules.shards import SHARD_ARRAYS, UNLABELLED_ARRAYS, ShardError, read_shard, sha256_of

POINT_ARRAYS = ("points", "part_id")
LABEL_ARRAYS = tuple(name for name in SHARD_ARRAYS if name not in POINT_ARRAYS)
INPUTS = ("points", "dense_points", "sample")

Batch = dict[str, Tensor]


def split_labels(batch: Batch) -> tuple[Batch, Batch]:
    """What a model's `forward` may see (`points`, `dense_points`, `sample`), and what only metrics may read."""
    inputs = {name: value for name, value in batch.items() if name in INPUTS}
    labels = {name: value for name, value in batch.items() if name not in INPUTS}
    return inputs, labels


class ArticulatedDataset(Dataset):
    """Clouds and labels of one split as batches of tensors.

    The clouds stay mapped into memory; the small arrays are held in it. Random rotation and noise are a pure function
    of (`seed`, key), whatever the number of workers and ranks and wherever a run was interrupted. A set without labels
    gives the same clouds, and of the label arrays `datamodules.shards.UNLABELLED_ARRAYS` only.

    Args:
        folder: Data set folder, `<root>/<category>/<source>-<view>[-<protocol>]`.
        split: `train` or `test`.
        num_points: N, size of the network's input.
        rotate: Turn every cloud, and its labels, by a uniformly random rotation about the origin.
        noise_std: Standard deviation of Gaussian noise per coordinate, in normalised units.
        dense: Also deliver `dense_points` and `dense_part_id`.
        seed: Of rotation and noise.
        occupancy: Also deliver `occupancy_points` and `occupancy`, of a set that has them (`datamodules.occupancy`).
        verify: Compare every shard with its checksum, once per file and process.

    Raises:
        ManifestError, ShardError: if a file is missing or damaged.
        ValueError: if the split is empty or its clouds have fewer than `num_points` points.
    """

    def __init__(
        self,
        folder: str | os.PathLike,
        split: str,
        num_points: int = 512,
        rotate: bool = False,
        noise_std: float = 0.0,
        dense: bool = True,
        seed: int = 0,
        occupancy: bool = False,
        verify: bool = True,
    ) -> None:
        self._options = (folder, split, num_points, rotate, noise_std, dense, seed, occupancy)
        self.num_points, self.rotate, self.noise_std, self.dense, self.seed = num_points, rotate, noise_std, dense, seed
        manifest = Manifest.load(folder)
        if not manifest.shards[split]:
            raise ValueError(f"{folder}: the {split} split has no samples. Make the set again with `make data`.")
        shards = [
            self._open(Path(folder) / split / e.name, e.samples, e.sha256, verify) for e in manifest.shards[split]
        ]
        for shard, entry in zip(shards, manifest.shards[split], strict=True):
            if ("part_id" in shard) != manifest.labelled:
                has = "no labels" if manifest.labelled else "labels"
                raise ShardError(f"{Path(folder) / split / entry.name}: shard has {has}, the manifest says otherwise.")
            if outside := set(shard["instance"].tolist()) - set(range(len(manifest.instances[split]))):
                raise ShardError(
                    f"{Path(folder) / split / entry.name}: shard has instance {min(outside)}, but the manifest names "
                    f"{len(manifest.instances[split])} of the {split} split. Remove {folder} and make the set again "
                    "with `make data`."
                )
        self._points = [shard["points"] for shard in shards]
        self._part_id = [shard["part_id"] for shard in shards] if manifest.labelled else None
        sizes = {points.shape[1] for points in self._points}
        if len(sizes) > 1:
            raise ShardError(f"{folder}: shards of the {split} split have clouds of different sizes {sorted(sizes)}.")
        if (available := sizes.pop()) < num_points:
            raise ValueError(f"{folder}: clouds have {available} points, num_points={num_points} asks for more.")
        names = [name for name in LABEL_ARRAYS if manifest.labelled or name in UNLABELLED_ARRAYS]
        self.labels = {name: np.concatenate([shard[name] for shard in shards]) for name in names}
        self._starts = np.cumsum([0] + [len(points) for points in self._points])
        self._occupancy = (
            self._open_occupancy(Path(folder), split, manifest.shards[split], verify) if occupancy else None
        )

    @staticmethod
    def _open(path: Path, samples: int, sha256: str, verify: bool) -> dict[str, np.ndarray]:
        shard = read_shard(path)
        if verify:
            status = path.stat()
            if _cached_sha256(path.resolve(), status.st_mtime_ns, status.st_size) != sha256:
                shard = read_shard(path, sha256)
        if len(shard["points"]) != samples:
            raise ShardError(f"{path}: shard has {len(shard['points'])} samples, the manifest says {samples}.")
        return shard

    @staticmethod
    def _open_occupancy(folder: Path, split: str, shards: Sequence[ShardEntry], verify: bool) -> list[np.ndarray]:
        """The occupancy samples of all shards."""
        index = OccupancyIndex.load(folder)
        samples = []
        for shard in shards:
            path, entry = samples_path(folder, split, shard.name), index.find(split, shard)
            if entry is None:
                raise OccupancyError(f"{path}: has no occupancy samples of {split} shard {shard.name}. {REMEDY}")
            samples.append(open_samples(path, shard.samples, index.points))
            status = path.stat()
            if verify and _cached_sha256(path.resolve(), status.st_mtime_ns, status.st_size) != entry.sha256:
                raise OccupancyError(f"{path}: is damaged, its SHA-256 is not that of the index. {REMEDY}")
        return samples

    def __getstate__(self) -> tuple:
        """Workers map the shards themselves instead of receiving them."""
        return self._options

    def __setstate__(self, options: tuple) -> None:
        self.__init__(*options, verify=False)

    def __len__(self) -> int:
        return int(self._starts[-1])

    def __getitems__(
        self,
        keys: Sequence[int] | Sequence[tuple[int, int]],  # B sample indices, or pairs (sample index, position)
    ) -> Batch:
        """A batch; see `ArticulatedDataModule` for its entries. A position draws a fresh rotation and fresh noise."""
        keys = np.asarray(keys, dtype=np.int64)
        index = keys if keys.ndim == 1 else keys[:, 0]
        shard = np.searchsorted(self._starts, index, side="right") - 1
        row = index - self._starts[shard]
        points = torch.from_numpy(self._gather(self._points, shard, row))
        batch = {name: torch.from_numpy(_widen(array[index])) for name, array in self.labels.items()}
        if self.dense and self._part_id is not None:
            batch["dense_part_id"] = torch.from_numpy(_widen(self._gather(self._part_id, shard, row)))
        if self._occupancy is not None:
            samples = [self._occupancy[s][r] for s, r in zip(shard.tolist(), row.tolist(), strict=True)]
            samples = torch.from_numpy(np.stack(samples).astype(np.float32))
            batch |= {"occupancy_points": samples[..., :3], "occupancy": samples[..., 3]}
        points = self._augment(points, batch, keys)
        if self.dense:
            batch["dense_points"] = points
        return batch | {"points": points[:, : self.num_points].contiguous(), "sample": torch.from_numpy(index.copy())}

    def _gather(self, arrays: list[np.ndarray], shard: np.ndarray, row: np.ndarray) -> np.ndarray:
        """Rows of the mapped arrays, only as many points of each as are wanted."""
        wanted = arrays[0].shape[1] if self.dense else self.num_points
        out = np.empty((len(row), wanted, *arrays[0].shape[2:]), arrays[0].dtype)
        for i, (s, r) in enumerate(zip(shard.tolist(), row.tolist(), strict=True)):
            out[i] = arrays[s][r, :wanted]
        return out

    def _augment(self, points: Tensor, batch: Batch, keys: np.ndarray) -> Tensor:
        """Noisy, rotated points; turns the labels in `batch` along."""
        if not (self.rotate or self.noise_std):
            return points
        # A counter-based generator starts anywhere in its stream at no cost; plain indices get streams of their own.
        counters = [[0, key[-1], len(key), 0] for key in keys.reshape(len(keys), -1).tolist()]
        streams = [np.random.Generator(np.random.Philox(key=self.seed, counter=counter)) for counter in counters]
        quaternion = torch.from_numpy(np.stack([s.standard_normal(4) for s in streams]))
        if self.noise_std:
            noise = np.stack([s.standard_normal(points.shape[1:], dtype=np.float32) for s in streams])
            points = points + self.noise_std * torch.from_numpy(noise)
        if self.rotate:
            rotation = roma.unitquat_to_rotmat(quaternion / quaternion.norm(dim=-1, keepdim=True)).float()
            points = points @ rotation.mT
            batch["center"] = (rotation @ batch["center"][..., None]).squeeze(-1)
            if self._occupancy is not None:
                batch["occupancy_points"] = batch["occupancy_points"] @ rotation.mT
            if self._part_id is None:
                return points
            for name in ("joint_axis", "joint_pivot"):
                batch[name] = batch[name] @ rotation.mT
            batch["object_rotation"] = rotation @ batch["object_rotation"]
            batch["part_pose"] = se3(rotation, rotation.new_zeros(3))[:, None] @ batch["part_pose"]
        return points


def spread_subset(
    instance: np.ndarray,  # [S] instance of every sample, in stored order (state by state)
    size: int,
) -> np.ndarray:  # [min(S, size)] ascending sample indices
    """A deterministic subset spread evenly over instances and, within each, over the stored order.

    Every instance's samples are cut into equal intervals with one random sample from each: a fixed step could fall in
    with the number of rotations or views per state and pick the same one every time.
    """
    generator = np.random.default_rng(0)
    instances = np.unique(instance)
    quota = np.zeros(len(instances), dtype=np.int64)
    members = [np.flatnonzero(instance == i) for i in instances]
    capacity = np.array([len(m) for m in members])
    for _ in range(min(size, len(instance))):
        quota[np.argmin(np.where(quota < capacity, quota / capacity, np.inf))] += 1
    chosen = []
    for samples, n in zip(members, quota.tolist(), strict=True):
        edges = np.linspace(0, len(samples), n + 1).astype(np.int64)
        chosen.append(samples[generator.integers(edges[:-1], edges[1:])])
    return np.sort(np.concatenate(chosen))


def evenly(
    values: np.ndarray,  # [S]
    size: int,
) -> np.ndarray:  # [min(S, size)]
    """A subset spread evenly over the stored order, both ends included."""
    return values[np.unique(np.linspace(0, len(values) - 1, min(size, len(values))).round().astype(int))]


def clouds_of_objects(
    instance: np.ndarray,  # [S] instance of every sample
    size: int,
    fewest: int,
    most: int,
) -> np.ndarray:  # [min(S, size)] ascending sample indices, more if a single object has more
    """Clouds of as many objects as fit, each with all of its clouds or `most` of them, objects spread evenly.

    Objects that have fewer than `fewest` clouds, and clouds beyond `most`, come in only where room is left.
    """
    members = [np.flatnonzero(instance == i) for i in np.unique(instance)]
    whole = [evenly(m, most) for m in members if len(m) >= fewest]
    chosen = np.zeros(0, dtype=np.int64)
    for count in range(len(whole), 0, -1):
        chosen = np.concatenate([whole[i] for i in evenly(np.arange(len(whole)), count)])
        if len(chosen) <= size:
            break
    others = np.setdiff1d(np.arange(len(instance)), chosen)
    return np.sort(np.concatenate([chosen, evenly(others, max(0, size - len(chosen)))]))


def _widen(array: np.ndarray) -> np.ndarray:
    """Integers as int64, torch's index type; floats as they are."""
    return array if array.dtype.kind == "f" else array.astype(np.int64)


@cache
def _cached_sha256(path: Path, mtime_ns: int, size: int) -> str:
    """Checksum of a file that has not changed since, as far as its modification time and size tell."""
    return sha256_of(path)
