"""The manifest: strict, atomic, byte-stable."""

from __future__ import annotations

import dataclasses
import json

import pytest

from datamodules.manifest import MANIFEST_NAME, Manifest, ManifestError, set_folder


def edit(folder, **changes) -> None:
    path = folder / MANIFEST_NAME
    content = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({name: value for name, value in content.items() if value != "remove"}))


def test_saving_what_was_loaded_gives_the_same_bytes(synthetic_set, tmp_path):
    manifest = Manifest.load(synthetic_set)
    manifest.save(tmp_path)
    assert (tmp_path / MANIFEST_NAME).read_bytes() == (synthetic_set / MANIFEST_NAME).read_bytes()
    assert Manifest.load(tmp_path) == manifest
    assert (manifest.num_parts, manifest.num_samples("train"), manifest.num_samples("test")) == (2, 12, 16)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"schema_version": 99}, "schema version is 99, this program reads version 4"),
        ({"schema_version": "remove"}, "schema version is None"),
        ({"seed": "remove"}, "missing fields: seed"),
        ({"mood": 1}, "unknown fields: mood"),
        ({"view": "inside"}, "view is 'inside'"),
        ({"protocol": "honest"}, "protocol is 'honest'"),
        ({"instances": {"train": ["a"]}}, "names the splits"),
        ({"instances": {"train": ["a"], "test": ["a"]}}, "twice"),
        ({"rest_state": {}}, "rest_state"),
        ({"left_out": {"train-0": "broken"}}, "'train-0' is both in a split and left out"),
        ({"left_out": ["a"]}, "damaged"),
        ({"split_by": "mood"}, "split_by is 'mood'"),
        ({"scans": {"train": []}}, "scans names the splits"),
        ({"joint_types": [0, 0]}, "2 entries"),
        ({"joint_types": [2]}, "joint_types are"),
        ({"joint_types": ["hinge"]}, "joint_types is"),
        ({"options": []}, "options is"),
        ({"options": None}, "options is None, expected dict"),
        ({"articulation_range": [[None, None]]}, "articulation_range is"),
        ({"articulation_range": [["a", "b"]]}, "articulation_range is"),
        ({"articulation_range": [[0.0, float("nan")]]}, "articulation_range is"),
        ({"rest_state": {f"{s}-{i}": [None] for s, n in (("train", 3), ("test", 2)) for i in range(n)}}, "rest_state"),
        ({"instances": {"train": "abc", "test": ["d"]}}, "instances is"),
        ({"scans": None}, "scans is None"),
        ({"checksums": {"a": None}}, "checksums is"),
        ({"shards": {"train": [{"name": "a", "samples": 1, "sha256": None}], "test": []}}, "sha256 is None"),
        ({"shards": {"train": [{"name": "a", "samples": "1", "sha256": ""}], "test": []}}, "samples is '1'"),
        ({"shards": {"train": [{"name": "a", "samples": 0, "sha256": ""}], "test": []}}, "a shard has no samples"),
        ({"shards": {"train": [{"name": "../a", "samples": 1, "sha256": ""}], "test": []}}, "plain file names"),
        ({"shards": {"train": [{"name": "a"}], "test": []}}, "damaged"),
        ({"shards": 3}, "damaged"),
    ],
)
def test_an_unsound_manifest_is_refused(synthetic_set, changes, message):
    edit(synthetic_set, **changes)
    with pytest.raises(ManifestError, match=f"manifest.json: .*{message}"):
        Manifest.load(synthetic_set)


def test_what_is_left_out_is_kept(synthetic_set, tmp_path):
    manifest = dataclasses.replace(Manifest.load(synthetic_set), left_out={"7": "two doors"})
    manifest.save(tmp_path)
    assert Manifest.load(tmp_path) == manifest


def test_version_1_did_not_record_what_is_left_out(synthetic_set):
    manifest = Manifest.load(synthetic_set)
    edit(synthetic_set, schema_version=1, left_out="remove")
    assert Manifest.load(synthetic_set) == manifest


def test_version_2_knew_labelled_sets_only(synthetic_set):
    manifest = Manifest.load(synthetic_set)
    edit(synthetic_set, schema_version=2, labelled="remove", split_by="remove", scans="remove")
    assert Manifest.load(synthetic_set) == manifest and manifest.labelled


def test_version_3_did_not_record_checksums(synthetic_set):
    manifest = Manifest.load(synthetic_set)
    edit(synthetic_set, schema_version=3, checksums="remove")
    assert Manifest.load(synthetic_set) == manifest


def test_a_set_without_labels_needs_no_rest_states_and_may_split_one_object(synthetic_set, tmp_path):
    manifest = Manifest.load(synthetic_set)
    unlabelled = dataclasses.replace(
        manifest, labelled=False, rest_state={}, articulation_range=(), split_by="scan",
        instances={"train": ("chair",), "test": ("chair",)}, scans={"train": ("chair/a.ply",), "test": ("chair/b.ply",)}
    )  # fmt: skip
    unlabelled.save(tmp_path)
    assert Manifest.load(tmp_path) == unlabelled
    with pytest.raises(ValueError, match="twice"):
        dataclasses.replace(unlabelled, split_by="instance")
    with pytest.raises(ValueError, match="rest_state"):
        dataclasses.replace(unlabelled, labelled=True)


@pytest.mark.parametrize("content", ["", "{", "[]", '{"schema_version": NaN}'])
def test_what_is_no_manifest_is_refused(synthetic_set, content):
    (synthetic_set / MANIFEST_NAME).write_text(content)
    with pytest.raises(ManifestError, match=r"manifest.json: .*make data"):
        Manifest.load(synthetic_set)


def test_a_missing_manifest_is_named(tmp_path):
    with pytest.raises(ManifestError, match=r"manifest.json: manifest is missing.*make data"):
        Manifest.load(tmp_path)


def test_splits_that_share_an_instance_cannot_be_described(synthetic_set):
    manifest = Manifest.load(synthetic_set)
    shared = {"train": manifest.instances["train"], "test": manifest.instances["train"][:1]}
    with pytest.raises(ValueError, match="twice"):
        dataclasses.replace(manifest, instances=shared)


def test_folder_names():
    assert str(set_folder("data", "oven")) == "data/oven/procedural-complete"
    assert str(set_folder("data", "oven", "urdf", "partial", "eap")) == "data/oven/urdf-partial-eap"
