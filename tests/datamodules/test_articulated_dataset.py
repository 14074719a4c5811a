"""Batches of a split: right samples, labels that stay true under augmentation, independence of workers."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from synthetic import write_synthetic_set
from torch.testing import assert_close
from unlabelled import without_labels

from articulate_ssl.geometry.screw import PRISMATIC, screw_motion
from articulate_ssl.geometry.se3 import invert_se3, transform_points
from datamodules.articulated_dataset import ArticulatedDataset, clouds_of_objects, evenly, split_labels, spread_subset
from datamodules.manifest import Manifest, ManifestError
from datamodules.shards import SHARD_ARRAYS, ShardError, read_shard


def rest_points(batch: dict[str, torch.Tensor]) -> torch.Tensor:  # [B, P, 3]
    """Every point moved back to the canonical object frame by its part's pose."""
    pose = torch.take_along_dim(batch["part_pose"], batch["dense_part_id"][..., None, None], dim=1)
    return transform_points(invert_se3(pose), batch["dense_points"][..., None, :])[..., 0, :]


def test_a_batch_holds_the_stored_rows_in_the_order_asked_for(synthetic_set):
    dataset = ArticulatedDataset(synthetic_set, "train", num_points=32)
    assert len(dataset) == 12
    batch = dataset.__getitems__([9, 0, 5])
    for b, (shard, row) in enumerate([(2, 1), (0, 0), (1, 1)]):
        stored = read_shard(synthetic_set / "train" / f"shard-{shard:05d}.npz")
        np.testing.assert_array_equal(batch["points"][b], stored["points"][row, :32])
        np.testing.assert_array_equal(batch["dense_points"][b], stored["points"][row])
        np.testing.assert_array_equal(batch["dense_part_id"][b], stored["part_id"][row])
        for name in set(SHARD_ARRAYS) - {"points", "part_id"}:
            np.testing.assert_array_equal(batch[name][b], stored[name][row])
    assert batch["sample"].tolist() == [9, 0, 5]
    integers = {name for name, value in batch.items() if not value.is_floating_point()}
    assert integers == {"sample", "instance", "dense_part_id", "joint_parent", "joint_child", "joint_type"}
    assert all(batch[name].dtype == torch.int64 for name in integers)


def test_a_model_can_be_given_inputs_without_labels(synthetic_set):
    inputs, labels = split_labels(ArticulatedDataset(synthetic_set, "test", 32).__getitems__([0, 1]))
    assert set(inputs) == {"points", "dense_points", "sample"}
    assert set(labels) == set(SHARD_ARRAYS) - {"points", "part_id"} | {"dense_part_id"}


def test_the_dense_arrays_can_be_left_out(synthetic_set):
    lean = ArticulatedDataset(synthetic_set, "train", 32, rotate=True, noise_std=0.1, dense=False)
    full = ArticulatedDataset(synthetic_set, "train", 32, rotate=True, noise_std=0.1, dense=True)
    keys = [(3, 100), (4, 101)]
    batch = lean.__getitems__(keys)
    assert not any(name.startswith("dense") for name in batch)
    assert_close(batch["points"], full.__getitems__(keys)["points"])


@pytest.mark.parametrize("joint_type", [0, PRISMATIC])
def test_labels_follow_the_rotated_points(tmp_path, joint_type):
    folder = write_synthetic_set(tmp_path, joint_type=joint_type, rotations=1)
    keys = [(i, 50 + i) for i in range(12)]
    stored = ArticulatedDataset(folder, "train", 32).__getitems__([i for i, _ in keys])
    turned = ArticulatedDataset(folder, "train", 32, rotate=True).__getitems__(keys)
    assert not torch.allclose(stored["points"], turned["points"], atol=0.1)
    assert_close(rest_points(turned), rest_points(stored), atol=1e-5, rtol=0)
    assert_close(turned["points"], turned["dense_points"][:, :32])
    assert_close(turned["dense_points"], stored["dense_points"] @ turned["object_rotation"].mT, atol=1e-5, rtol=0)
    metric = [b["dense_points"] * b["scale"][:, None, None] + b["center"][:, None] for b in (stored, turned)]
    assert_close(metric[1], metric[0] @ turned["object_rotation"].mT, atol=1e-5, rtol=0)
    motion = screw_motion(
        turned["joint_axis"][:, 0], turned["joint_pivot"][:, 0], turned["joint_state"][:, 0], joint_type
    )
    assert_close(motion @ turned["part_pose"][:, 0], turned["part_pose"][:, 1], atol=1e-5, rtol=0)


def test_rotations_are_uniform(synthetic_set):
    dataset = ArticulatedDataset(synthetic_set, "train", 1, rotate=True, dense=False)
    rotation = dataset.__getitems__([(0, position) for position in range(4000)])["object_rotation"]
    assert_close(rotation @ rotation.mT, torch.eye(3).expand_as(rotation), atol=1e-5, rtol=0)
    # Under the uniform distribution E[R] = 0 and E[R_ij^2] = 1/3; four standard errors.
    assert rotation.mean(0).abs().max() < 4 * (1 / 3 / 4000) ** 0.5
    assert (rotation.square().mean(0) - 1 / 3).abs().max() < 4 * (4 / 45 / 4000) ** 0.5


def test_augmentation_depends_on_seed_and_key_alone(synthetic_set):
    dataset = ArticulatedDataset(synthetic_set, "train", 32, rotate=True, noise_std=0.01, seed=3)
    twin = pickle.loads(pickle.dumps(dataset))
    whole = dataset.__getitems__([(0, 7), (1, 8), (0, 9)])
    for b, key in enumerate([(0, 7), (1, 8), (0, 9)]):
        for name, value in twin.__getitems__([key]).items():
            assert torch.equal(value[0], whole[name][b]), name
    assert not torch.allclose(whole["points"][0], whole["points"][2], atol=0.05)
    other = ArticulatedDataset(synthetic_set, "train", 32, rotate=True, seed=4).__getitems__([(0, 7)])
    assert not torch.allclose(other["points"][0], whole["points"][0], atol=0.05)


def test_noise_has_the_stated_size(synthetic_set):
    stored = ArticulatedDataset(synthetic_set, "train", 128).__getitems__(range(12))
    noisy = ArticulatedDataset(synthetic_set, "train", 128, noise_std=0.05).__getitems__(range(12))
    difference = noisy["points"] - stored["points"]
    assert difference.std() == pytest.approx(0.05, rel=0.05)
    assert_close(noisy["part_pose"], stored["part_pose"])


def test_pickling_does_not_carry_the_clouds(synthetic_set):
    dataset = ArticulatedDataset(synthetic_set, "train", 32)
    assert len(pickle.dumps(dataset)) < 1000
    assert_close(pickle.loads(pickle.dumps(dataset)).__getitems__([5]), dataset.__getitems__([5]))


def test_damage_is_named_unless_verification_is_off(synthetic_set):
    path = synthetic_set / "train" / "shard-00001.npz"
    content = bytearray(path.read_bytes())
    content[1000] ^= 1
    path.write_bytes(content)
    with pytest.raises(ShardError, match=r"shard-00001.npz: shard is damaged.*make data"):
        ArticulatedDataset(synthetic_set, "train", 32)
    assert len(ArticulatedDataset(synthetic_set, "train", 32, verify=False)) == 12
    assert len(ArticulatedDataset(synthetic_set, "test", 32)) == 16


def test_truncated_deleted_and_foreign_shards_are_named(synthetic_set):
    first, second = (synthetic_set / "train" / f"shard-{i:05d}.npz" for i in range(2))
    content = first.read_bytes()
    first.write_bytes(content[: len(content) // 2])
    with pytest.raises(ShardError, match=r"shard-00000.npz: shard is damaged or truncated"):
        ArticulatedDataset(synthetic_set, "train", 32, verify=False)
    first.write_bytes(content)
    second.unlink()
    with pytest.raises(ShardError, match=r"shard-00001.npz: shard is missing"):
        ArticulatedDataset(synthetic_set, "train", 32)
    second.write_bytes((synthetic_set / "test" / "shard-00000.npz").read_bytes())
    with pytest.raises(ShardError, match=r"shard-00001.npz: shard has 8 samples, the manifest says 4"):
        ArticulatedDataset(synthetic_set, "train", 32, verify=False)


def test_a_checksum_is_computed_once_per_unchanged_file(synthetic_set, monkeypatch):
    ArticulatedDataset(synthetic_set, "train", 32)
    monkeypatch.setattr("datamodules.articulated_dataset.sha256_of", lambda path: pytest.fail(f"read {path} again"))
    ArticulatedDataset(synthetic_set, "train", 32)


def test_too_many_points_and_missing_sets_are_refused(synthetic_set, tmp_path):
    with pytest.raises(ValueError, match="clouds have 128 points, num_points=129 asks for more"):
        ArticulatedDataset(synthetic_set, "train", 129)
    with pytest.raises(ManifestError, match="manifest is missing"):
        ArticulatedDataset(tmp_path, "train")


def test_a_split_without_samples_is_refused(tmp_path):
    folder = write_synthetic_set(tmp_path, test_instances=0)
    assert Manifest.load(folder).num_samples("test") == 0
    with pytest.raises(ValueError, match="test split has no samples"):
        ArticulatedDataset(folder, "test", 32)


def test_a_subset_spreads_over_instances_states_and_rotations():
    instance = np.repeat(np.arange(5), 100 * 10)
    subset = spread_subset(instance, 250)
    assert len(np.unique(subset)) == 250
    assert np.array_equal(subset, spread_subset(instance, 250))
    assert np.bincount(instance[subset]).tolist() == [50] * 5
    # 50 samples of 100 states x 10 rotations: every pair of states once, all rotations about equally often.
    state, rotation = subset % 1000 // 10, subset % 10
    assert all(np.bincount(state[instance[subset] == i] // 2, minlength=50).tolist() == [1] * 50 for i in range(5))
    assert np.bincount(rotation, minlength=10).min() > 10


@pytest.mark.parametrize(("size", "expected"), [(1, 1), (7, 7), (12, 12), (1000, 12)])
def test_a_subset_has_the_size_asked_for_even_over_unequal_instances(size, expected):
    instance = np.array([0] * 2 + [1] * 9 + [4])
    subset = spread_subset(instance, size)
    assert len(np.unique(subset)) == len(subset) == expected


def test_evenly_reaches_both_ends_and_repeats_nothing():
    assert evenly(np.arange(10, 20), 4).tolist() == [10, 13, 16, 19]
    assert evenly(np.arange(3), 9).tolist() == [0, 1, 2]


def _counts(instance: np.ndarray, chosen: np.ndarray) -> dict[int, int]:
    assert len(np.unique(chosen)) == len(chosen) and (np.diff(chosen) > 0).all()
    return {int(i): int(n) for i, n in zip(*np.unique(instance[chosen], return_counts=True), strict=True)}


def test_clouds_of_objects_are_whole_objects_spread_evenly():
    instance = np.arange(20).repeat(10)
    counts = _counts(instance, clouds_of_objects(instance, 192, 8, 16))
    assert sorted(counts.values()) == [2] + [10] * 19
    counts = _counts(instance, clouds_of_objects(instance, 30, 8, 16))
    assert counts == {0: 10, 10: 10, 19: 10} or counts == {0: 10, 9: 10, 19: 10}


def test_what_has_few_clouds_comes_last_and_what_has_many_gives_some():
    instance = np.array([0] * 3 + [1] * 40 + [2] * 9 + [4])
    counts = _counts(instance, clouds_of_objects(instance, 25, 8, 16))
    assert counts == {1: 16, 2: 9}
    assert sum(_counts(instance, clouds_of_objects(instance, 30, 8, 16)).values()) == 30
    assert _counts(instance, clouds_of_objects(instance, 99, 8, 16)) == {0: 3, 1: 40, 2: 9, 4: 1}
    assert _counts(instance, clouds_of_objects(instance, 4, 8, 16)) == {1: 16}  # one object at least
    assert sum(_counts(instance, clouds_of_objects(instance, 4, 50, 60)).values()) == 4  # where none has enough


def test_without_labels_the_clouds_are_the_same_and_the_labels_are_gone(tmp_path):
    labelled, bare = write_synthetic_set(tmp_path / "a"), without_labels(write_synthetic_set(tmp_path / "b"))
    keys = [(3, 100), (9, 101)]
    options = {"num_points": 32, "rotate": True, "noise_std": 0.1, "seed": 4}
    with_labels, without = (ArticulatedDataset(f, "train", **options).__getitems__(keys) for f in (labelled, bare))
    assert set(without) == {"points", "dense_points", "sample", "instance", "center", "scale"}
    for name, value in without.items():
        assert torch.equal(value, with_labels[name]), name


def test_shards_that_contradict_the_manifest_about_labels_are_refused(tmp_path):
    labelled, bare = write_synthetic_set(tmp_path / "a"), without_labels(write_synthetic_set(tmp_path / "b"))
    Manifest.load(labelled).save(bare)
    with pytest.raises(ShardError, match="shard has no labels, the manifest says otherwise"):
        ArticulatedDataset(bare, "train", 32, verify=False)


def test_a_shard_of_objects_that_the_manifest_does_not_name_is_refused(synthetic_set):
    manifest = Manifest.load(synthetic_set)
    rest = {name: state for name, state in manifest.rest_state.items() if name != "test-1"}
    replace(manifest, instances=manifest.instances | {"test": ("test-0",)}, rest_state=rest).save(synthetic_set)
    with pytest.raises(ShardError, match=r"test/shard-00001\.npz: shard has instance 1, but the manifest names 1 of"):
        ArticulatedDataset(synthetic_set, "test", 32)
