import argparse
import json
import re
import sys
import types

import numpy as np
import pytest
import synthetic_predictions as synthetic
import torch

from articulate_ssl.cli.predict import run
from articulate_ssl.geometry.orientation_range import OrientationRange
from articulate_ssl.inference.checkpoint_file import CHECKPOINT_KEY, read_checkpoint
from articulate_ssl.inference.point_cloud_io import normalise_cloud
from articulate_ssl.inference.prediction import Prediction


class FakeModule(torch.nn.Module):
    """Knows the answer for the laptop of `synthetic_predictions`, in any unit and origin."""

    category = "laptop"
    state_range = torch.tensor([[0.1, 1.7]])
    orientation = OrientationRange()

    def predict_cloud(self, points, refine):
        self.refine = refine
        prediction, truth = synthetic.laptop()
        normalised, center, scale = normalise_cloud(points, 256)
        _, true_center, true_scale = normalise_cloud(truth.numpy(), 256)
        ours = (truth.numpy() - true_center) / true_scale
        nearest = np.linalg.norm(normalised[:, None] - ours[None], axis=2).argmin(axis=1)
        moved = {n: getattr(prediction, n) / true_scale for n in ("part_shape", "assembly", "canonical_pivot")}
        for name in ("base_pose", "part_pose"):
            moved[name] = getattr(prediction, name).clone()
            moved[name][..., :3, 3] = (moved[name][..., :3, 3] - torch.tensor(true_center).float()) / true_scale
        moved["joint_pivot"] = (prediction.joint_pivot - torch.tensor(true_center).float()) / true_scale
        moved["part_id"] = prediction.part_id[:, nearest]
        return Prediction(**{**vars(prediction), **moved}), center, scale, normalised


@pytest.fixture
def module(monkeypatch):
    fake = FakeModule()

    def load_module(path):
        read_checkpoint(path)
        return fake

    monkeypatch.setitem(
        sys.modules, "articulate_ssl.training.checkpoint", types.SimpleNamespace(load_module=load_module)
    )
    return fake


@pytest.fixture
def scan_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    torch.save({CHECKPOINT_KEY: {}, "state_dict": {}, "hyper_parameters": {}}, "laptop.ckpt")
    np.save("scan.npy", synthetic.laptop()[1].numpy() * 30 + [100, 0, -50])
    return tmp_path


def predict(*arguments) -> int:
    return run(["predict", *map(str, arguments)])


def test_a_scan_becomes_a_folder_of_results_and_a_summary(scan_folder, module, capsys):
    assert predict("scan.npy", "--ckpt", "laptop.ckpt", "--out", "results") == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    names = {"prediction.json", "parts.ply", "reconstruction.ply", "object.urdf", "picture.png"}
    meshes = {"meshes/part_0.stl", "meshes/part_1.stl"}
    found = {str(p.relative_to(scan_folder / "results")) for p in (scan_folder / "results").rglob("*") if p.is_file()}
    assert found == names | meshes
    assert all(name.split("/")[-1] in captured.out for name in found)
    assert "laptop" in captured.out and "revolute" in captured.out and "68.8°" in captured.out
    assert module.refine is True


def test_the_answer_is_in_the_frame_of_the_scan(scan_folder, module):
    assert predict("scan.npy", "--ckpt", "laptop.ckpt", "--out", "results") == 0
    summary = json.loads((scan_folder / "results/prediction.json").read_text())
    truth, _ = synthetic.laptop()
    expected = truth.joint_pivot[0, 0].numpy() * 30 + [100, 0, -50]
    axis = np.array(summary["joints"][0]["axis"])
    np.testing.assert_allclose(np.cross(np.array(summary["joints"][0]["pivot"]) - expected, axis), 0, atol=1e-3)
    pose = np.array(summary["parts"][1]["pose"])
    np.testing.assert_allclose(pose[:3, :3], truth.part_pose[0, 1, :3, :3], atol=1e-6)
    np.testing.assert_allclose(pose[:3, 3], truth.part_pose[0, 1, :3, 3].numpy() * 30 + [100, 0, -50], atol=1e-3)
    assert summary["checkpoint"] == "laptop.ckpt"


def test_defaults_and_refinement_flag(scan_folder, module):
    assert predict("scan.npy", "--ckpt", "laptop.ckpt", "--no-refine") == 0
    assert (scan_folder / "scan-prediction/prediction.json").exists()
    assert module.refine is False


@pytest.mark.parametrize(
    ("points", "problem"),
    [
        (np.full((300, 3), np.nan), "300 of 300 points are NaN"),
        (np.empty((0, 3)), "no points"),
        (np.ones((1, 3)), "one point"),
        (np.ones((300, 3)), "coincide"),
        (np.ones((300, 4)), r"\[N, 3\]"),
    ],
)
def test_a_bad_scan_exits_2_with_one_line_that_names_it(scan_folder, module, capsys, points, problem):
    np.save("bad.npy", points)
    assert_refused(capsys, ["bad.npy", "--ckpt", "laptop.ckpt"], f"bad.npy: .*{problem}")
    assert not (scan_folder / "bad-prediction").exists()


def test_a_missing_scan_exits_2(scan_folder, module, capsys):
    assert_refused(capsys, ["none.ply", "--ckpt", "laptop.ckpt"], "none.ply: no such file")


def test_bad_checkpoints_exit_2(scan_folder, module, capsys):
    content = (scan_folder / "laptop.ckpt").read_bytes()
    (scan_folder / "short.ckpt").write_bytes(content[: len(content) // 2])
    torch.save({"model": torch.ones(2)}, "foreign.ckpt")
    torch.save({"state_dict": argparse.Namespace()}, "pickled.ckpt")
    for name, problem in [
        ("none.ckpt", "no such checkpoint"),
        ("short.ckpt", "damaged"),
        ("foreign.ckpt", "another project"),
        ("pickled.ckpt", "pickled objects"),
    ]:
        assert_refused(capsys, ["scan.npy", "--ckpt", name], f"{name}: .*{problem}")
    assert not (scan_folder / "scan-prediction").exists()


def test_a_folder_that_is_a_file_exits_2(scan_folder, module, capsys):
    assert_refused(capsys, ["scan.npy", "--ckpt", "laptop.ckpt", "--out", "laptop.ckpt"], "laptop.ckpt")


@pytest.mark.parametrize("device", ["toaster", "cuda:99"])
def test_a_device_that_is_not_there_exits_2(scan_folder, module, capsys, device):
    with pytest.raises(SystemExit) as stop:
        predict("scan.npy", "--ckpt", "laptop.ckpt", "--device", device)
    assert stop.value.code == 2
    assert device in capsys.readouterr().err


def test_a_bug_is_not_reported_as_bad_input(scan_folder, module):
    module.predict_cloud = lambda points, refine: [][1]
    with pytest.raises(IndexError):
        predict("scan.npy", "--ckpt", "laptop.ckpt")


def assert_refused(capsys, arguments, pattern) -> None:
    assert predict(*arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1 and "Traceback" not in captured.err
    assert re.search(pattern, captured.err), captured.err
