"""Training goes on where it was cut off, methods see what they are given, and every method of the table is there."""

import json

import pytest
import torch
from synthetic import write_synthetic_set
from toy_methods import Killed, Shells, problem

from articulate_ssl.baselines import METHODS, method_class, runner
from articulate_ssl.baselines import __main__ as command
from articulate_ssl.baselines.method import (
    DENSE_CLOUDS,
    JOINT_LINES,
    OCCUPANCY,
    POSES,
    RECONSTRUCTION,
    SEGMENTATION,
    TEST_PARTS,
    Method,
)
from articulate_ssl.baselines.runner import SHOWN, problem_of, seeded, seen_in_test, seen_in_training, train
from articulate_ssl.geometry.screw import PRISMATIC
from articulate_ssl.metrics.calibration import calibrate
from datamodules.articulated_data_module import ArticulatedDataModule

POINTS = 48
OTHER = "tested-on-procedural"


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("data")
    write_synthetic_set(root, points=POINTS)
    return root


def _data(root, seed: int = 0) -> ArticulatedDataModule:
    options = {"num_points": POINTS, "batch_size": 4, "val_samples": 0, "dense_in_fit": True}
    return ArticulatedDataModule("laptop", root=str(root), seed=seed, **options)


def _trained(root, folder, dies_at=None, steps=None) -> tuple[Shells, dict]:
    method = seeded(Shells, problem(POINTS), seed=3, steps=steps)
    method.dies_at = dies_at
    return method, train(method, _data(root, 3), folder, seed=3)


def _same(left: Method, right: Method) -> bool:
    pairs = zip(left.state_dict().values(), right.state_dict().values(), strict=True)
    return all(torch.equal(a, b) for a, b in pairs)


@pytest.mark.parametrize("dies_at", [2, 7, 11])
def test_a_training_that_was_cut_off_ends_like_one_that_was_not(root, tmp_path, monkeypatch, dies_at):
    monkeypatch.setattr(runner, "SAVE_EVERY", 5)
    whole, note = _trained(root, tmp_path / "whole")
    with pytest.raises(Killed):
        _trained(root, tmp_path / "cut", dies_at)
    resumed, again = _trained(root, tmp_path / "cut")
    assert _same(whole, resumed)
    assert resumed.prepared == (1 if dies_at < 5 else 0)  # what it found is in the checkpoint
    assert again["what"] == note["what"]
    assert again["seconds"] > 0
    assert not (tmp_path / "cut" / "last.ckpt").exists()


def test_what_is_trained_is_not_trained_again_unless_something_else_is_asked_for(root, tmp_path):
    first, note = _trained(root, tmp_path)
    second, same = _trained(root, tmp_path, dies_at=0)
    assert _same(first, second) and same == note
    with pytest.raises(Killed):
        _trained(root, tmp_path, dies_at=0, steps=13)


def test_other_options_do_not_go_on_from_what_is_there(root, tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "SAVE_EVERY", 5)
    with pytest.raises(Killed):
        _trained(root, tmp_path / "cut", dies_at=7)
    other, _ = _trained(root, tmp_path / "cut", steps=13)
    whole, _ = _trained(root, tmp_path / "whole", steps=13)
    assert other.prepared == 1 and _same(other, whole)


def test_the_report_says_what_was_tested(root, tmp_path):
    method, note = _trained(root, tmp_path)
    runner.test(method, _data(root), tmp_path, note)
    report = json.loads((tmp_path / "metrics.json").read_text())
    assert report["method"] == "shells" and report["given"] == ["part labels"] and report["says"] == ["segmentation"]
    assert (report["train_seconds"], report["trained_on"]) == (note["seconds"], runner.CPU)
    assert report["seconds_per_cloud"] > 0
    assert report["parameters"] == 12 * 32 + 32 + 32 * 2 + 2
    assert report["samples"] == 16


def test_a_training_is_tested_on_objects_from_elsewhere_too(root, tmp_path, monkeypatch, capsys):
    write_synthetic_set(tmp_path / "other", points=POINTS, test_instances=3, seed=9)
    monkeypatch.setattr(command, "method_class", lambda _name: Shells)
    options = ["npcs_epn", "--category", "laptop", "--root", str(root), "--points", str(POINTS), "--batch-size", "4"]
    options += ["--out", str(tmp_path / "out")]
    assert command.main(options) == 0
    trained = (tmp_path / "out" / "weights.pt").stat().st_mtime_ns
    seen = []
    monkeypatch.setattr(runner, "calibrate", lambda _said, labels: seen.append(labels) or calibrate(_said, labels))
    assert command.main([*options, "--test-source", "procedural", "--test-root", str(tmp_path / "other")]) == 0
    assert (tmp_path / "out" / "weights.pt").stat().st_mtime_ns == trained
    own, other = (json.loads((tmp_path / "out" / place / "metrics.json").read_text()) for place in ("", OTHER))
    assert (own["instances"], other["instances"]) == (2, 3)
    assert own["seg_miou"]["mean"] != other["seg_miou"]["mean"]
    first = next(iter(_data(root).calibration_dataloader()))
    assert torch.equal(seen[0]["points"][:4], first["points"])  # of the objects that trained
    write_synthetic_set(tmp_path / "drawers", points=POINTS, joint_type=PRISMATIC)
    assert command.main([*options, "--test-source", "procedural", "--test-root", str(tmp_path / "drawers")]) == 2
    assert "has other parts or joints" in capsys.readouterr().err


def test_methods_see_what_they_are_given_and_nothing_else(root):
    data = _data(root)
    data.setup("fit")
    batch = next(iter(data.train_dataloader())) | {"occupancy": torch.ones(1), "occupancy_points": torch.ones(1)}
    free = {"points", "dense_points", "sample", "instance", "center", "scale"}
    assert set(seen_in_training(batch, ())) == free
    assert set(seen_in_training(batch, (OCCUPANCY,))) == free | {"occupancy", "occupancy_points"}
    assert set(seen_in_training(batch, tuple(SHOWN))) == set(batch)
    assert set(seen_in_test(batch, ())) == {"points"}
    assert set(seen_in_test(batch, (DENSE_CLOUDS,))) == {"points", "dense_points"}
    assert set(seen_in_test(batch, (TEST_PARTS,))) == {"points", "dense_points", "dense_part_id"}


def test_the_problem_is_read_off_the_set(root):
    found = problem_of(_data(root), orientation_range=100.0)
    assert (found.num_parts, found.joint_type, found.num_points, found.orientation_range) == (2, 0, POINTS, 100.0)
    assert found.state_range == pytest.approx(1.3)


@pytest.mark.parametrize("name", METHODS)
def test_every_method_is_there_and_says_what_it_is(name):
    method = method_class(name)
    assert issubclass(method, Method)
    assert method.title and set(method.given) <= set(SHOWN)
    assert method.says and set(method.says) <= {SEGMENTATION, POSES, JOINT_LINES, RECONSTRUCTION}
    assert method.effort.batch_size > 0 and set(method.views) <= {"complete", "partial"}


def test_an_unknown_method_is_refused():
    with pytest.raises(ValueError, match="npcs_epn"):
        method_class("magic")
