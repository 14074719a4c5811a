import json

import numpy as np
import pytest
import synthetic_predictions as synthetic
import torch
import trimesh

from articulate_ssl.inference import export, urdf
from articulate_ssl.inference.articulation import posed_parts
from articulate_ssl.inference.checkpoint_file import CheckpointError
from articulate_ssl.inference.export import write_prediction
from articulate_ssl.inference.part_colour import part_colour
from articulate_ssl.prediction import Prediction

OBJECTS = [synthetic.laptop, synthetic.drawer, synthetic.arm]
CENTER, SCALE = np.array([10.0, -3.0, 5.0]), 0.4


@pytest.fixture(autouse=True)
def quick_picture(monkeypatch):
    """Pictures have tests of their own, and take a second each."""
    monkeypatch.setattr(export, "draw_prediction", lambda *arguments: arguments[-1].touch())


def write(folder, make, center=CENTER, scale=SCALE, **changes):
    prediction, points = make()
    points = points.numpy()
    limits = torch.tensor([[-0.1, 0.3]]).repeat(prediction.joint_state.shape[1], 1)
    arguments = dict(
        prediction=prediction,
        points=points,
        center=center,
        scale=scale,
        cloud=points.astype(np.float64) * scale + center,
        state_range=limits,
        category="thing",
        checkpoint="thing.ckpt",
    )
    files = write_prediction(folder, **(arguments | changes))
    return prediction, files, json.loads((folder / "prediction.json").read_text())


@pytest.mark.parametrize("make", OBJECTS)
def test_the_folder_holds_what_was_promised_and_no_more(tmp_path, make):
    prediction, files, _ = write(tmp_path, make)
    meshes = {f"meshes/part_{k}.stl" for k in range(prediction.num_parts)}
    expected = {"prediction.json", "parts.ply", "reconstruction.ply", "object.urdf", "picture.png"} | meshes
    assert {str(f.relative_to(tmp_path)) for f in files} == expected
    assert {str(f.relative_to(tmp_path)) for f in tmp_path.rglob("*") if f.is_file()} == expected


@pytest.mark.parametrize("make", OBJECTS)
def test_json_poses_put_the_part_shapes_on_the_users_scan(tmp_path, make):
    prediction, _, summary = write(tmp_path, make)
    expected = posed_parts(prediction)[0].double().numpy() * SCALE + CENTER
    for part, wanted in zip(summary["parts"], expected, strict=True):
        pose = np.array(part["pose"])
        shape = prediction.part_shape[0, part["id"]].numpy() * SCALE
        np.testing.assert_allclose(shape @ pose[:3, :3].T + pose[:3, 3], wanted, atol=1e-6)
        np.testing.assert_allclose(part["canonical_size"], np.ptp(shape, axis=0), rtol=1e-6)


@pytest.mark.parametrize("make", OBJECTS)
def test_the_users_unit_and_origin_give_the_same_object_in_his_frame(tmp_path, make):
    _, _, small = write(tmp_path / "a", make, center=np.zeros(3), scale=1.0)
    prediction, _, large = write(tmp_path / "b", make, center=np.array([500.0, 0, -70]), scale=1000.0)
    for a, b in zip(small["parts"], large["parts"], strict=True):
        pose_a, pose_b = np.array(a["pose"]), np.array(b["pose"])
        np.testing.assert_allclose(pose_b[:3, :3], pose_a[:3, :3], atol=1e-12)
        np.testing.assert_allclose(pose_b[:3, 3], pose_a[:3, 3] * 1000 + [500, 0, -70], atol=1e-9)
        assert (a["num_points"], a["parent"]) == (b["num_points"], b["parent"])
    for j, (a, b) in enumerate(zip(small["joints"], large["joints"], strict=True)):
        factor = {"revolute": 1, "prismatic": 1000}[a["type"]]
        assert b["state"] == pytest.approx(a["state"] * factor)
        np.testing.assert_allclose(b["limits"], np.array(a["limits"]) * factor)
        np.testing.assert_allclose(b["axis"], prediction.joint_axis[0, j], atol=1e-7)
        np.testing.assert_allclose(b["pivot"], np.array(a["pivot"]) * 1000 + [500, 0, -70], atol=1e-9)
        np.testing.assert_allclose(b["canonical_pivot"], np.array(a["canonical_pivot"]) * 1000, atol=1e-9)
    assert large["reconstruction_error"] == pytest.approx(1000 * small["reconstruction_error"])
    assert small["kinematic_error"] < 1e-6


def test_the_tree_is_the_predicted_one(tmp_path):
    _, _, summary = write(tmp_path, synthetic.arm)
    assert summary["base"] == 0
    assert [p["parent"] for p in summary["parts"]] == [None, 0, 1]
    assert [(j["type"], j["parent"], j["child"]) for j in summary["joints"]] == [
        ("revolute", 0, 1),
        ("prismatic", 1, 2),
    ]
    assert (summary["schema_version"], summary["category"], summary["checkpoint"]) == (1, "thing", "thing.ckpt")


def test_every_point_of_the_scan_is_coloured_by_its_part(tmp_path):
    prediction, points = synthetic.laptop()
    seen = points.numpy()[::4]
    prediction = Prediction(**{**vars(prediction), "part_id": prediction.part_id[:, ::4]})
    cloud = points.numpy() * SCALE + CENTER
    _, _, summary = write(tmp_path, synthetic.laptop, prediction=prediction, points=seen, cloud=cloud)
    coloured = trimesh.load(tmp_path / "parts.ply")
    np.testing.assert_allclose(coloured.vertices, cloud, atol=1e-5)
    true_parts = synthetic.laptop()[0].part_id[0].numpy()
    assert (coloured.colors[:, :3] == part_colour(true_parts)).all(axis=1).mean() > 0.95
    assert sum(p["num_points"] for p in summary["parts"]) == len(cloud)


def test_a_diverged_prediction_is_refused_before_anything_is_written(tmp_path):
    prediction, _ = synthetic.laptop()
    prediction.part_pose[0, 1, 0, 0] = float("nan")
    with pytest.raises(CheckpointError, match=r"thing.ckpt: predicts NaN.*part_pose.*train again"):
        write(tmp_path / "out", synthetic.laptop, prediction=prediction)
    assert not (tmp_path / "out").exists()


def test_a_batch_is_refused(tmp_path):
    with pytest.raises(ValueError, match="batch of 2"):
        write(tmp_path, synthetic.laptop, prediction=synthetic.laptop()[0][torch.tensor([0, 0])])


def test_a_failure_half_way_leaves_the_earlier_results(tmp_path, monkeypatch):
    write(tmp_path, synthetic.laptop)
    (tmp_path / "notes.txt").write_text("mine")
    before = {f: f.read_bytes() for f in tmp_path.rglob("*") if f.is_file()}

    def fail(_):
        raise RuntimeError("disk full")

    monkeypatch.setattr(urdf, "part_mesh", fail)
    monkeypatch.setattr(export, "_compact_json", fail)
    with pytest.raises(RuntimeError):
        write(tmp_path, synthetic.laptop)
    assert {f: f.read_bytes() for f in tmp_path.rglob("*") if f.is_file()} == before


def test_kinematic_error_measures_poses_that_disobey_their_joint(tmp_path):
    prediction, _ = synthetic.laptop()
    prediction.part_pose[0, 1, :3, 3] += torch.tensor([0.0, 0.0, 0.1])
    _, _, summary = write(tmp_path, synthetic.laptop, prediction=prediction)
    assert summary["kinematic_error"] == pytest.approx(0.1 * SCALE / 2, rel=1e-4)


def test_limits_are_in_the_unit_of_the_scan(tmp_path):
    _, _, summary = write(tmp_path, synthetic.arm)
    assert [j["limits"] for j in summary["joints"]] == [pytest.approx([-0.1, 0.3]), pytest.approx([-0.04, 0.12])]


def test_the_json_is_readable_and_keeps_its_numbers(tmp_path):
    _, _, summary = write(tmp_path, synthetic.laptop, checkpoint="runs/[ 3 ]/a  b.ckpt")
    text = (tmp_path / "prediction.json").read_text()
    assert summary["checkpoint"] == "runs/[ 3 ]/a  b.ckpt"
    assert '"colour": [0, 114, 178]' in text
    assert "[0.0, 0.0, 0.0, 1.0]" in text
