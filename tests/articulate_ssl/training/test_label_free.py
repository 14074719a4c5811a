"""Training and testing on a user's own scans: no label is missed, and none was ever used."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from synthetic import write_synthetic_set
from tiny import POINTS, fit, quiet_trainer, tiny_data, tiny_module
from unlabelled import without_labels

from articulate_ssl.metrics.label_free import PER_CLOUD, PER_JOINT, PER_PART
from articulate_ssl.training.label_free_report import LabelFreeReport
from datamodules.manifest import Manifest
from datamodules.shards import read_shard
from render.generate import main

STEPS = 4


def export_scans(folder: Path, root: Path) -> None:
    """Every training cloud of a set as a file of its own, in the stored order."""
    for shard in sorted((folder / "train").glob("*.npz")):
        for row, points in enumerate(read_shard(shard)["points"]):
            (root / shard.stem).mkdir(parents=True, exist_ok=True)
            np.save(root / shard.stem / f"{row:03d}.npy", points)


@pytest.fixture(scope="module")
def labelled(tmp_path_factory) -> Path:
    """A procedural set; its root is two folders up."""
    out = tmp_path_factory.mktemp("labelled")
    words = ["--category", "laptop", "--out", str(out), "--train-instances", "3", "--test-instances", "1"]
    assert main([*words, "--states", "4", "--rotations", "2", "--points", "128", "--workers", "1"]) == 0
    return out / "laptop" / "procedural-complete"


@pytest.fixture(scope="module")
def scans(labelled, tmp_path_factory) -> Path:
    """The training clouds of that set as the user's scans."""
    root = tmp_path_factory.mktemp("scans")
    export_scans(labelled, root)
    return root


def clouds_set(scans: Path, out: Path, *options: str) -> Path:
    """Data set of category `laptop`, made of scans."""
    words = ["--category", "laptop", "--source", "clouds", "--root", str(scans), "--out", str(out), "--points", "128"]
    assert main([*words, "--workers", "1", "--rotations", "2", *options]) == 0
    return out / "laptop" / "clouds-complete"


@pytest.fixture(scope="module")
def trained(scans, tmp_path_factory):
    """Root of a set of scans, and a module trained on it."""
    out = tmp_path_factory.mktemp("out")
    clouds_set(scans, out)
    module = tiny_module(steps=STEPS)
    fit(module, out, STEPS, source="clouds")
    return out, module.eval()


def test_scans_written_from_a_procedural_set_give_the_weights_of_that_set(labelled, scans, tmp_path):
    """Byte for byte: `--normalise none` takes points as they are, and the order of files is that of the samples."""
    everything = ("--normalise", "none", "--train-instances", "3", "--test-instances", "0")
    folder = clouds_set(scans, tmp_path, *everything)
    stored = [np.concatenate([read_shard(s)["points"] for s in sorted((f / "train").glob("*.npz"))]) for f in
              (labelled, folder)]  # fmt: skip
    assert stored[0].tobytes() == stored[1].tobytes()
    modules = tiny_module(steps=STEPS), tiny_module(steps=STEPS)
    fit(modules[0], labelled.parents[1], STEPS)
    fit(modules[1], tmp_path, STEPS, source="clouds")
    states = [module.state_dict() for module in modules]
    assert states[0].keys() == states[1].keys() and any("backbone" in name for name in states[0])
    for name, value in states[0].items():
        assert value.numpy().tobytes() == states[1][name].numpy().tobytes(), name
    fresh = tiny_module(steps=STEPS).state_dict()
    assert any(not torch.equal(value, fresh[name]) for name, value in states[0].items())


def test_scans_in_another_order_and_unit_give_other_weights(scans, trained, tmp_path):
    """The comparison above can fail."""
    other = tiny_module(steps=STEPS)
    clouds_set(scans, tmp_path, "--seed", "1")
    fit(other, tmp_path, STEPS, source="clouds")
    assert any(not torch.equal(v, other.state_dict()[n]) for n, v in trained[1].state_dict().items())


def test_a_test_without_labels_reports_what_can_be_known_without(trained):
    out, module = trained
    trainer = quiet_trainer(out)
    trainer.test(module, tiny_data(out, source="clouds"), verbose=False)
    content = json.loads((out / "metrics.json").read_text())
    assert set(PER_PART) | set(PER_JOINT) | set(PER_CLOUD) - {"probability"} <= set(content)
    assert (content["samples"], content["failures"], content["labelled"]) == (8, 0, False)
    assert content["relative_error"]["mean"] > 0 and 0 <= content["repeat_miou"]["mean"] <= 1
    assert not {"r_err_deg", "seg_miou", "calibration"} & set(content)
    assert "repeat_r_deg" in (out / "metrics.csv").read_text()
    assert (out / "test_samples.png").read_bytes().startswith(b"\x89PNG")


def test_figures_of_a_labelled_set_without_its_labels_do_not_read_them(tmp_path):
    """The synthetic set, its labels removed: trains, tests, and the scans are named in the pictures."""
    folder = without_labels(write_synthetic_set(tmp_path))
    module = tiny_module(steps=2)
    fit(module, tmp_path, 2)
    quiet_trainer(tmp_path).test(module.eval(), tiny_data(tmp_path), verbose=False)
    content = json.loads((tmp_path / "metrics.json").read_text())
    assert content["samples"] == Manifest.load(folder).num_samples("test")


def test_clouds_of_an_upright_camera_are_tilted_and_others_turned_over(trained):
    seen = []

    def predict(points, dense):
        # The second look is decided on as the first one is: on all points of the same, turned cloud.
        assert dense.shape[1] > points.shape[1]
        torch.testing.assert_close(dense[:, : points.shape[1]], points)
        seen.append(points)
        return trained[1].predict_points(points)

    batch = {"dense_points": torch.rand(6, 128, 3) - 0.5, "instance": torch.arange(6), "sample": torch.arange(6)}
    batch["points"] = batch["dense_points"][:, :POINTS]
    angles = {}
    for limited in (True, False):
        report = LabelFreeReport(predict, limited)
        report.update(trained[1].predict_points(batch["points"]), batch, 0.1, None)
        second = seen.pop()
        assert second.shape == (6, POINTS, 3) and not torch.allclose(second, batch["points"])
        # Which rotation brings the second cloud's points onto the first one's: the one under which they are among them.
        angles[limited] = max(_turn_between(a, b) for a, b in zip(batch["dense_points"], second, strict=True))
    assert angles[True] <= 21 < angles[False]


def _turn_between(cloud: torch.Tensor, turned: torch.Tensor) -> float:
    """Degrees, found from distances to the origin, which no rotation changes."""
    nearest = (turned.norm(dim=-1)[:, None] - cloud.norm(dim=-1)).abs().argmin(dim=1)
    u, _, vt = torch.linalg.svd(cloud[nearest].T.double() @ turned.double())
    rotation = u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.det(u @ vt).sign())]).double()) @ vt
    return float(torch.rad2deg(torch.arccos(((rotation.trace() - 1) / 2).clamp(-1, 1))))
