"""Occupancy samples in batches: the stored ones, turned with their cloud, and refused if they are not the set's."""

from __future__ import annotations

import pickle
from dataclasses import replace

import pytest
import torch
from occupied import POINTS, write_occupied_set
from synthetic import write_synthetic_set
from torch.testing import assert_close

from datamodules.articulated_data_module import ArticulatedDataModule
from datamodules.articulated_dataset import ArticulatedDataset, split_labels
from datamodules.manifest import Manifest
from datamodules.occupancy import OccupancyEntry, OccupancyError, OccupancyIndex, samples_path
from datamodules.verify import occupancy_problems, verify_set


@pytest.fixture
def sampled_set(tmp_path):
    """A set with samples."""
    return write_occupied_set(tmp_path)


def test_samples_turn_with_the_cloud(sampled_set):
    dataset = ArticulatedDataset(sampled_set, "train", POINTS, rotate=True, occupancy=True)
    batch = dataset.__getitems__([(9, 4), (0, 7)])
    assert_close(batch["occupancy_points"][:, ::2], batch["points"][:, :POINTS:2], atol=2e-3, rtol=0)
    assert batch["occupancy"].unique().tolist() == [0.0, 1.0]
    assert batch["occupancy"][:, ::2].all() and not batch["occupancy"][:, 1::2].any()
    stored = ArticulatedDataset(sampled_set, "train", 32, occupancy=True).__getitems__([9, 0])
    assert (stored["occupancy_points"] - batch["occupancy_points"]).abs().max() > 0.05


def test_only_who_asks_gets_them_and_nothing_else_changes(sampled_set):
    keys = [(3, 5), (8, 6)]
    without = ArticulatedDataset(sampled_set, "train", 32, rotate=True).__getitems__(keys)
    with_samples = ArticulatedDataset(sampled_set, "train", 32, rotate=True, occupancy=True).__getitems__(keys)
    assert set(with_samples) - set(without) == {"occupancy_points", "occupancy"}
    assert all(torch.equal(with_samples[name], value) for name, value in without.items())
    assert "occupancy" not in split_labels(with_samples)[0], "a model's forward does not see them"


def test_workers_open_them_too(sampled_set):
    dataset = ArticulatedDataset(sampled_set, "train", 32, occupancy=True)
    copy = pickle.loads(pickle.dumps(dataset))
    assert torch.equal(copy.__getitems__([1])["occupancy_points"], dataset.__getitems__([1])["occupancy_points"])


def test_the_data_module_delivers_them_in_training_only(sampled_set):
    data = ArticulatedDataModule("laptop", str(sampled_set.parents[1]), num_points=32, occupancy=True)
    data.setup("fit")
    assert next(iter(data.train_dataloader()))["occupancy_points"].shape == (8, POINTS, 3)
    data.setup("test")
    assert "occupancy" not in next(iter(data.test_dataloader()))
    assert "occupancy" not in next(iter(data.calibration_dataloader()))


def test_verification_reads_them_too(sampled_set):
    assert not list(occupancy_problems(sampled_set, Manifest.load(sampled_set)))
    index = OccupancyIndex.load(sampled_set)
    paths = [samples_path(sampled_set, entry.split, entry.shard) for entry in index.entries]
    paths[0].unlink()
    paths[1].write_bytes(paths[1].read_bytes()[:-2] + b"\x00\x3c")
    stale = replace(index.entries[2], shard_sha256="0" * 64)
    replace(index, entries=(*index.entries[:2], stale)).save(sampled_set)
    problems = verify_set(sampled_set)
    assert [problem.split(": ")[0] for problem in problems] == [str(path) for path in paths]
    assert "cannot be read" in problems[0] and "damaged" in problems[1] and "not the one" in problems[2]


def test_a_set_without_samples_says_how_to_get_them(tmp_path):
    folder = write_synthetic_set(tmp_path)
    with pytest.raises(OccupancyError, match=r"occupancy\.json: the set has no occupancy samples.*--occupancy"):
        ArticulatedDataset(folder, "train", 32, occupancy=True)


def test_samples_of_another_set_and_damaged_ones_are_refused(sampled_set):
    index = OccupancyIndex.load(sampled_set)
    first = index.entries[0]
    path = samples_path(sampled_set, "train", first.shard)
    path.write_bytes(path.read_bytes()[:-2] + b"\x00\x3c")
    with pytest.raises(OccupancyError, match=r"shard-00000\.npy: is damaged"):
        ArticulatedDataset(sampled_set, "train", 32, occupancy=True)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(OccupancyError, match=r"shard-00000\.npy: "):
        ArticulatedDataset(sampled_set, "train", 32, occupancy=True, verify=False)
    other = OccupancyEntry(first.split, first.shard, "0" * 64, first.sha256)
    OccupancyIndex(POINTS, 0.0, (other, *index.entries[1:])).save(sampled_set)
    with pytest.raises(OccupancyError, match=r"has no occupancy samples of train shard shard-00000\.npz"):
        ArticulatedDataset(sampled_set, "train", 32, occupancy=True)
