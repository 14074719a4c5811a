import argparse
import json
import os
import re

import numpy as np
import pytest
import synthetic_predictions as synthetic
import torch
from scan_predictions import result_of

from articulate_ssl.cli.predict import run
from articulate_ssl.geometry.orientation_range import OrientationRange
from articulate_ssl.inference.checkpoint_file import CHECKPOINT_KEY, read_checkpoint
from articulate_ssl.inference.export import animation
from articulate_ssl.inference.point_cloud_io import normalise_cloud
from articulate_ssl.inference.prediction import Prediction, ScanEstimate
from articulate_ssl.inference.viewer import html_page
from articulate_ssl.pretrained import estimator
from articulate_ssl.training import shipped_weights


class FakeModule(torch.nn.Module):
    """Knows the answer for the laptop of `synthetic_predictions`, in any unit and origin."""

    category = "laptop"
    state_range = torch.tensor([[0.1, 1.7]])
    orientation = OrientationRange()
    probability = unlike = None

    def predict_clouds(self, clouds, refine):
        self.refine = refine
        return [self.predict_cloud(points) for points in clouds]

    def predict_cloud(self, points):
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
        whole = Prediction(**{**vars(prediction), **moved})
        return ScanEstimate(whole, None, normalised, center, scale, self.probability, self.unlike)


@pytest.fixture
def module(monkeypatch):
    fake = FakeModule()

    def load_model(path):
        read_checkpoint(path)
        return fake

    monkeypatch.setattr(estimator, "load_model", load_model)
    return fake


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package with weights of three kinds, which say how unlike the scan is."""
    folder, modules = tmp_path / "weights", {}
    folder.mkdir()
    for name, unlike in (("laptop-complete", 0.9), ("laptop-depth", 0.4), ("oven-depth", 0.7)):
        (folder / f"{name}.safetensors").touch()
        fake = modules[name] = FakeModule()
        fake.category, fake.unlike, fake.probability = name.split("-")[0], unlike, 0.6
        fake.orientation = OrientationRange(100.0 if name.endswith("depth") else 180.0)
    monkeypatch.setattr(shipped_weights, "WEIGHTS_FOLDER", folder)
    monkeypatch.setattr(estimator, "load_model", lambda path: modules[path.stem])
    return modules


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
    assert names | meshes <= found
    assert all(name.split("/")[-1] in captured.out for name in found)
    assert "laptop" in captured.out and "revolute" in captured.out and "68.8°" in captured.out
    assert module.refine is True


def test_drawing_a_moving_picture_is_told_on_stderr(scan_folder, module, capsys, monkeypatch):
    monkeypatch.setattr(animation, "FRAMES", 4)
    assert predict("scan.npy", "--ckpt", "laptop.ckpt", "--out", "results", "--formats", "gif") == 0
    captured = capsys.readouterr()
    assert "drawing moving.gif: took" in captured.err and "drawing" not in captured.out
    assert (scan_folder / "results/moving.gif").is_file()


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


def test_what_the_object_stands_on_is_left_out_if_asked(scan_folder, module, caplog):
    low, high = (scan := np.load("scan.npy")).min(axis=0), scan.max(axis=0)
    across = np.random.default_rng(0).uniform(2 * low - high, 2 * high - low, size=(4000, 3))
    np.save("scene.npy", np.concatenate([scan, across * [1, 1, 0] + [0, 0, low[2] - 1]]))
    assert predict("scene.npy", "--ckpt", "laptop.ckpt", "--out", "cut", "--on-table") == 0
    assert predict("scan.npy", "--ckpt", "laptop.ckpt", "--out", "alone") == 0
    cut, alone = (json.loads((scan_folder / name / "prediction.json").read_text()) for name in ("cut", "alone"))
    counts = [sum(part["num_points"] for part in summary["parts"]) for summary in (cut, alone)]
    assert 0.95 * len(scan) < counts[0] <= len(scan) == counts[1]
    assert "scene.npy: " in caplog.text and "points left out: what the object stands on" in caplog.text


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


@pytest.mark.parametrize("out", ["laptop.ckpt", "laptop.ckpt/results"])
def test_a_folder_that_is_a_file_exits_2_before_anything_is_predicted(scan_folder, module, capsys, out):
    module.predict_clouds = None
    words = ["scan.npy", "--ckpt", "laptop.ckpt", "--out", out]
    assert_refused(capsys, words, rf"{out}: no folder .*laptop\.ckpt is a file; name another")


def test_a_folder_that_may_not_be_written_into_exits_2(scan_folder, module, capsys, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may write everywhere
    words = ["scan.npy", "--ckpt", "laptop.ckpt", "--out", "new/results"]
    assert_refused(capsys, words, rf"new/results: .*{scan_folder} may not be written into")
    assert not (scan_folder / "new").exists()


@pytest.mark.parametrize("device", ["toaster", "cuda:99", "hpu"])
def test_a_device_that_is_not_there_exits_2(scan_folder, module, capsys, device):
    with pytest.raises(SystemExit) as stop:
        predict("scan.npy", "--ckpt", "laptop.ckpt", "--device", device)
    assert stop.value.code == 2
    assert device in capsys.readouterr().err


def test_a_bug_is_not_reported_as_bad_input(scan_folder, module):
    module.predict_clouds = lambda clouds, refine: [][1]
    with pytest.raises(IndexError):
        predict("scan.npy", "--ckpt", "laptop.ckpt")


def test_a_category_uses_the_weights_of_the_package_that_explain_the_scan_best(scan_folder, package, capsys):
    assert predict("scan.npy", "--category", "laptop") == 0
    summary = json.loads((scan_folder / "scan-prediction/prediction.json").read_text())
    assert summary["checkpoint"] == "laptop-depth"
    captured = capsys.readouterr()
    assert "oven" not in captured.out and "upright camera" in captured.out
    table = captured.out[: captured.out.index("parts")]
    assert table.index("depth") < table.index("complete") and "40%" in table and "60%" in table


def test_a_view_that_is_asked_for_is_the_only_one_tried(scan_folder, package, capsys):
    assert predict("scan.npy", "--category", "laptop", "--view", "complete") == 0
    summary = json.loads((scan_folder / "scan-prediction/prediction.json").read_text())
    assert summary["checkpoint"] == "laptop-complete"
    captured = capsys.readouterr()
    assert "upright camera" not in captured.out and "90% of the training clouds" in captured.out


def test_auto_tries_every_category_and_says_how_sure_it_is(scan_folder, package, capsys):
    assert predict("scan.npy", "--category", "auto") == 0
    captured = capsys.readouterr()
    assert "unsure: oven would explain this scan, too" in captured.out
    package["oven-depth"].unlike = 1.0
    assert predict("scan.npy", "--category", "auto") == 0
    assert "sure: only laptop explains" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        ([], "one of the arguments --category --ckpt is required"),
        (["--category", "laptop", "--ckpt", "laptop.ckpt"], "not allowed with argument"),
        (["--category", "toaster"], "invalid choice: 'toaster'"),
        (["--ckpt", "laptop.ckpt", "--view", "depth"], "--view chooses among the weights of the package"),
        (["--category", "laptop", "--formats", "json,fax"], "no export is called fax"),
        (["--category", "laptop", "--formats", ""], "nothing would be written; name some of clouds"),
        (["--category", "laptop", "--formats", "json", "--check"], "--check reads urdf or mjcf"),
        (["--category", "laptop", "--metres-per-unit", "1"], "--metres-per-unit is for --check"),
        (["--category", "laptop", "--check", "--metres-per-unit", "-1"], "'-1' is no length"),
        (["--category", "laptop", "--check", "--metres-per-unit", "nan"], "'nan' is no length"),
    ],
)
def test_arguments_that_contradict_each_other_exit_2(scan_folder, package, capsys, words, problem):
    with pytest.raises(SystemExit) as stop:
        predict("scan.npy", *words)
    assert stop.value.code == 2
    assert problem in capsys.readouterr().err


def test_a_view_that_the_package_has_not_exits_2(scan_folder, package, capsys):
    assert_refused(capsys, ["scan.npy", "--category", "oven", "--view", "complete"], "oven: no weights for view")


def test_only_the_formats_that_are_asked_for_are_written(scan_folder, module, capsys):
    assert predict("scan.npy", "--ckpt", "laptop.ckpt", "--formats", "clouds", "--out", "results", "--html") == 0
    files = {path.name for path in (scan_folder / "results").iterdir() if path.is_file()}
    page = html_page.write(result_of(synthetic.laptop), scan_folder)[0].name
    assert files == {"parts.ply", "reconstruction.ply", page}
    assert page in capsys.readouterr().out


def test_a_check_prints_what_mujoco_found(scan_folder, module, capsys):
    pytest.importorskip("mujoco")
    assert predict("scan.npy", "--ckpt", "laptop.ckpt", "--formats", "mjcf", "--check") == 0
    out = capsys.readouterr().out
    assert "physics check" in out and "object.xml: loads" in out
    # The folder holds the model now; what is written there next is checked alone.
    assert predict("scan.npy", "--ckpt", "laptop.ckpt", "--formats", "urdf", "--check") == 0
    out = capsys.readouterr().out
    assert "object.urdf: loads" in out and "object.xml" not in out


def assert_refused(capsys, arguments, pattern) -> None:
    assert predict(*arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1 and "Traceback" not in captured.err
    assert re.search(pattern, captured.err), captured.err
