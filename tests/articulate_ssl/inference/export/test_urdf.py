from dataclasses import replace

import numpy as np
import pytest
import synthetic_predictions as synthetic
import torch
import trimesh
import yourdfpy
from scan_predictions import OBJECTS, keep_solid, result_of

from articulate_ssl.inference.articulation import articulate, posed_parts
from articulate_ssl.inference.export import urdf
from articulate_ssl.inference.prediction import Prediction


@pytest.fixture(autouse=True)
def solid(monkeypatch):
    keep_solid(monkeypatch)


def write(folder, make) -> tuple[Prediction, yourdfpy.URDF]:
    result = result_of(make)
    prediction = result.prediction
    limits = torch.tensor([[-0.1, 0.12]]).repeat(prediction.joint_state.shape[1], 1)
    urdf.write(replace(result, limits=limits), folder)
    robot = yourdfpy.URDF.load(str(folder / "object.urdf"))
    robot.update_cfg({f"joint_{j}": state for j, state in enumerate(prediction.joint_state[0].tolist())})
    return prediction, robot


@pytest.mark.parametrize("make", OBJECTS)
def test_forward_kinematics_at_the_predicted_state_reproduce_the_part_poses(tmp_path, make):
    prediction, robot = write(tmp_path, make)
    for k in range(prediction.num_parts):
        assembly = np.eye(4)
        assembly[:3, 3] = prediction.assembly[0, k]
        visual = robot.link_map[f"part_{k}"].visuals[0].origin
        pose = prediction.base_pose[0].numpy() @ robot.get_transform(f"part_{k}") @ visual @ assembly
        np.testing.assert_allclose(pose, prediction.part_pose[0, k], atol=1e-6)


@pytest.mark.parametrize("make", OBJECTS)
def test_meshes_at_the_predicted_state_lie_on_the_scan(tmp_path, make):
    prediction, robot = write(tmp_path, make)
    mesh = robot.scene.to_mesh().apply_transform(prediction.base_pose[0].numpy())
    points = posed_parts(prediction)[0].reshape(-1, 3).numpy()
    assert trimesh.proximity.closest_point(mesh, points)[1].max() < 1e-6
    assert mesh.is_watertight


@pytest.mark.parametrize("make", OBJECTS)
def test_any_other_state_moves_the_meshes_as_the_prediction_articulates(tmp_path, make):
    prediction, robot = write(tmp_path, make)
    states = torch.linspace(0.02, 0.1, prediction.joint_state.shape[1], dtype=torch.float64)
    robot.update_cfg({f"joint_{j}": state for j, state in enumerate(states.tolist())})
    mesh = robot.scene.to_mesh().apply_transform(prediction.base_pose[0].numpy())
    points = articulate(prediction, states)[0].reshape(-1, 3).numpy()
    assert trimesh.proximity.closest_point(mesh, points)[1].max() < 1e-6


def test_limits_are_the_range_widened_to_the_predicted_state(tmp_path):
    limits = [joint.limit for joint in write(tmp_path, synthetic.drawer)[1].joint_map.values()]
    assert [(x.lower, x.upper) for x in limits] == [pytest.approx((-0.1, 0.12))] * 3
    opened = write(tmp_path, synthetic.laptop)[1].joint_map["joint_0"].limit  # by 1.2, beyond the range
    assert (opened.lower, opened.upper) == pytest.approx((-0.1, 1.2))


def test_the_links_form_the_predicted_tree(tmp_path):
    joints = write(tmp_path, synthetic.arm)[1].joint_map.values()
    found = [(j.type, j.parent, j.child) for j in joints]
    assert found == [("revolute", "part_0", "part_1"), ("prismatic", "part_1", "part_2")]
