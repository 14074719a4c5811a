"""`python -m datamodules.verify`: every kind of damage is named, and none hides another."""

from __future__ import annotations

import dataclasses
import re
import shutil

import numpy as np
import pytest
from synthetic import write_synthetic_set
from unlabelled import without_labels

from articulate_ssl.geometry.screw import PRISMATIC
from datamodules.manifest import Manifest
from datamodules.shards import read_shard, write_shard
from datamodules.verify import main, verify_set


def rewrite(folder, change, split: str = "train") -> None:
    """Change the arrays of a split's first shard, and the manifest's checksum along."""
    manifest = Manifest.load(folder)
    path = folder / split / manifest.shards[split][0].name
    arrays = {name: array.copy() for name, array in read_shard(path).items()}
    change(arrays)
    entry = dataclasses.replace(manifest.shards[split][0], sha256=write_shard(path, arrays))
    shards = manifest.shards | {split: (entry, *manifest.shards[split][1:])}
    dataclasses.replace(manifest, shards=shards).save(folder)


@pytest.mark.parametrize(
    ("view", "protocol", "joint_type"),
    [("complete", None, 0), ("partial", "honest", 0), ("partial", "eap", PRISMATIC)],
)
def test_sound_sets_pass(tmp_path, capsys, view, protocol, joint_type):
    folder = write_synthetic_set(tmp_path, view=view, protocol=protocol, joint_type=joint_type)
    assert main([str(folder)]) == 0
    assert "sound" in capsys.readouterr().out


def test_every_damaged_file_is_named_in_one_run(tmp_path, synthetic_set, capsys):
    flipped, truncated, deleted = (synthetic_set / "train" / f"shard-{i:05d}.npz" for i in range(3))
    stray = synthetic_set / "test" / "shard-00099.npz"
    content = bytearray(flipped.read_bytes())
    content[1000] ^= 4
    flipped.write_bytes(content)
    truncated.write_bytes(truncated.read_bytes()[:-10])
    deleted.unlink()
    shutil.copy(synthetic_set / "test" / "shard-00000.npz", stray)
    assert main([str(synthetic_set)]) == 2
    lines = capsys.readouterr().err.splitlines()
    for path, word in (
        (flipped, "damaged"),
        (truncated, "damaged"),
        (deleted, "missing"),
        (stray, "not in the manifest"),
    ):
        assert sum(line.startswith(f"{path}: ") and word in line for line in lines) == 1
    assert "4 problem(s)" in lines[-1]


def test_a_folder_without_a_manifest_is_named(tmp_path, capsys):
    assert main([str(tmp_path)]) == 2
    assert "manifest.json: manifest is missing" in capsys.readouterr().err


def slip(array: np.ndarray, value: float) -> None:
    """Spoil the second sample."""
    array[1:2].flat[0] = value


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: slip(a["part_id"], 7), r"part_id is outside 0\.\.1 \(sample 1 and 0 more of 4\)"),
        (lambda a: a["part_id"].fill(0), "no point belongs to part 'lid'"),
        (lambda a: slip(a["instance"], 3), r"instance is outside 0\.\.2"),
        (lambda a: slip(a["joint_parent"], -1), "joint_parent is outside"),
        (lambda a: slip(a["joint_child"], 0), "form no tree"),
        (lambda a: slip(a["joint_type"], 1), "joint_type differs"),
        (lambda a: slip(a["scale"], 0), "scale is not positive"),
        (lambda a: a["joint_axis"].__imul__(1.01), "joint_axis is not of unit length"),
        (lambda a: a["object_rotation"].__imul__(1.01), "object_rotation is not a rotation"),
        (lambda a: a["part_pose"][2, 1, :3, 0].__imul__(-1), "part_pose mirrors"),
        (lambda a: slip(a["part_pose"][:, 0, 3], 0.1), "last row"),
        (lambda a: slip(a["joint_state"], 2.5), "contradicts axis, pivot and state of joint 0"),
        (lambda a: slip(a["joint_state"], 2.5), "state of joint 0 is outside the articulation range"),
        (lambda a: slip(a["points"], 0.5), "points are not centred on their mean"),
        (lambda a: a["points"].__imul__(1.5), "points at rest reach beyond a box of diagonal 1"),
        (lambda a: slip(a["joint_pivot"], 0.3), "contradicts"),
        (lambda a: a["joint_axis"].__imul__(-1), "contradicts"),
        (lambda a: a.update(object_rotation=np.roll(a["object_rotation"], 1, axis=1)), "not turned by object_rotation"),
    ],
)
def test_wrong_labels_under_a_right_checksum_are_named(synthetic_set, change, message):
    rewrite(synthetic_set, change)
    problems = verify_set(synthetic_set)
    assert any(re.match(f"{synthetic_set}/train/shard-00000.npz: .*{message}", problem) for problem in problems), (
        problems
    )


def test_the_number_of_parts_must_be_the_manifests(synthetic_set):
    rewrite(synthetic_set, lambda a: a.update(part_pose=a["part_pose"][:, :1], part_center=a["part_center"][:, :1]))
    assert "has 1 parts and 1 joints, the manifest says 2 and 1" in verify_set(synthetic_set)[0]


def test_sets_without_labels_are_checked_for_what_they_have(synthetic_set):
    assert verify_set(without_labels(synthetic_set)) == []

    def spoil(arrays):
        arrays["scale"][2] = -1
        arrays["instance"][0] = 7

    rewrite(synthetic_set, spoil)
    problems = verify_set(synthetic_set)
    assert len(problems) == 2 and "scale is not positive" in problems[1] and "instance is outside 0..2" in problems[0]


def test_labels_that_the_manifest_denies_are_a_problem(synthetic_set):
    manifest = Manifest.load(synthetic_set)
    dataclasses.replace(manifest, labelled=False, rest_state={}, articulation_range=()).save(synthetic_set)
    assert all("has labels, the manifest says otherwise" in problem for problem in verify_set(synthetic_set))
