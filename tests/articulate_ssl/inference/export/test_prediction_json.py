import json

import numpy as np
import pytest
import synthetic_predictions as synthetic
import torch
from scan_predictions import CENTER, OBJECTS, SCALE, result_of

from articulate_ssl.inference.articulation import posed_parts
from articulate_ssl.inference.export import prediction_json


def write(folder, make, **changes) -> dict:
    (file,) = prediction_json.write(result_of(make, **changes), folder)
    return json.loads(file.read_text())


@pytest.mark.parametrize("make", OBJECTS)
def test_json_poses_put_the_part_shapes_on_the_users_scan(tmp_path, make):
    prediction, summary = make()[0], write(tmp_path, make)
    expected = posed_parts(prediction)[0].double().numpy() * SCALE + CENTER
    for part, wanted in zip(summary["parts"], expected, strict=True):
        pose = np.array(part["pose"])
        shape = prediction.part_shape[0, part["id"]].numpy() * SCALE
        np.testing.assert_allclose(shape @ pose[:3, :3].T + pose[:3, 3], wanted, atol=1e-6)
        np.testing.assert_allclose(part["canonical_size"], np.ptp(shape, axis=0), rtol=1e-6)


@pytest.mark.parametrize("make", OBJECTS)
def test_the_users_unit_and_origin_give_the_same_object_in_his_frame(tmp_path, make):
    small = write(tmp_path, make, center=np.zeros(3), scale=1.0)
    prediction, large = make()[0], write(tmp_path, make, center=np.array([500.0, 0, -70]), scale=1000.0)
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
    assert small["margin"] == large["margin"] == pytest.approx(0.4)


def test_the_tree_is_the_predicted_one(tmp_path):
    summary = write(tmp_path, synthetic.arm)
    assert summary["base"] == 0
    assert [p["parent"] for p in summary["parts"]] == [None, 0, 1]
    assert [(j["type"], j["parent"], j["child"]) for j in summary["joints"]] == [
        ("revolute", 0, 1),
        ("prismatic", 1, 2),
    ]
    assert (summary["schema_version"], summary["category"], summary["checkpoint"]) == (1, "thing", "thing.ckpt")


def test_kinematic_error_measures_poses_that_disobey_their_joint(tmp_path):
    prediction, _ = synthetic.laptop()
    prediction.part_pose[0, 1, :3, 3] += torch.tensor([0.0, 0.0, 0.1])
    summary = write(tmp_path, synthetic.laptop, prediction=prediction)
    assert summary["kinematic_error"] == pytest.approx(0.1 * SCALE / 2, rel=1e-4)


def test_limits_are_in_the_unit_of_the_scan(tmp_path):
    summary = write(tmp_path, synthetic.arm)
    assert [j["limits"] for j in summary["joints"]] == [pytest.approx([-0.1, 0.3]), pytest.approx([-0.04, 0.12])]


def test_the_json_is_readable_and_keeps_its_numbers(tmp_path):
    summary = write(tmp_path, synthetic.laptop, checkpoint="runs/[ 3 ]/a  b.ckpt")
    text = (tmp_path / "prediction.json").read_text()
    assert summary["checkpoint"] == "runs/[ 3 ]/a  b.ckpt"
    assert '"colour": [0, 114, 178]' in text
    assert "[0.0, 0.0, 0.0, 1.0]" in text
