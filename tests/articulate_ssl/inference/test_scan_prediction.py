import json
import re

import numpy as np
import pytest
import synthetic_predictions as synthetic
import torch
from scan_predictions import CENTER, OBJECTS, SCALE, result_of

from articulate_ssl.inference.articulation import posed_parts
from articulate_ssl.inference.checkpoint_file import CheckpointError


@pytest.mark.parametrize("make", OBJECTS)
def test_the_prediction_is_in_the_frame_of_the_scan(make):
    result = result_of(make)
    expected = posed_parts(make()[0]).double() * SCALE + torch.tensor(CENTER)
    torch.testing.assert_close(posed_parts(result.prediction), expected, atol=1e-6, rtol=0)


def test_every_point_of_the_scan_has_the_part_of_the_nearest_point_that_the_network_saw():
    prediction, points = synthetic.laptop()
    cloud = np.repeat(points.numpy() * SCALE + CENTER, 3, axis=0)
    result = result_of(synthetic.laptop, cloud=cloud)
    np.testing.assert_array_equal(result.part_id, np.repeat(prediction.part_id[0].numpy(), 3))


def test_a_diverged_prediction_is_refused():
    prediction, _ = synthetic.laptop()
    prediction.part_pose[0, 1, 0, 0] = float("nan")
    with pytest.raises(CheckpointError, match=r"thing.ckpt: predicts NaN.*part_pose.*train again"):
        result_of(synthetic.laptop, prediction=prediction)


def test_a_batch_is_refused():
    with pytest.raises(ValueError, match="batch of 2"):
        result_of(synthetic.laptop, prediction=synthetic.laptop()[0][torch.tensor([0, 0])])


def test_articulated_to_its_own_states_it_is_where_it_was_scanned():
    for make in OBJECTS:
        result = result_of(make)
        moved = result.articulate(result.states)
        np.testing.assert_allclose(moved, result.reconstruction, atol=1e-5)
        assert moved.shape == result.reconstruction.shape == (len(result.parts), *result.parts[0].shape.shape)


def test_only_what_a_joint_moves_moves():
    result = result_of(synthetic.drawer)
    joint = result.joints[1]
    states = result.states.copy()
    states[1] += 0.05
    moved = np.linalg.norm(result.articulate(states) - result.articulate(result.states), axis=-1)
    np.testing.assert_allclose(moved[joint.child], 0.05, atol=1e-9)
    others = [part.id for part in result.parts if part.id != joint.child]
    np.testing.assert_allclose(moved[others], 0, atol=1e-9)


@pytest.mark.parametrize("states", [[], [0.1, 0.2], [float("nan")]])
def test_states_that_do_not_fit_the_joints_are_refused(states):
    with pytest.raises(ValueError, match="1 finite joint states are needed"):
        result_of(synthetic.laptop).articulate(states)


@pytest.mark.parametrize(
    ("make", "limits", "said"),
    [  # the laptop's lid is at 1.2 radians, the drawers are .2, .1 and 0 out
        (synthetic.laptop, [0.0, 1.1], ""),
        (synthetic.laptop, [0.0, 0.9], r"joint_0 at 69° \(of 0° to 52°\), well outside what training showed"),
        (synthetic.laptop, [1.6, 2.6], r"joint_0 at 69° \(of 92° to 149°\)"),
        (
            synthetic.drawer,
            [0.0, 0.095],
            r"with joint_0 at 0.08 \(of 0 to 0.038\), well outside what training showed: it may",
        ),
    ],
)
def test_joints_well_beyond_what_training_showed_are_warned_of(make, limits, said):
    states = make()[0].joint_state.shape[1]
    result = result_of(make, state_range=torch.tensor([limits]).repeat(states, 1), unlike=0.5)
    assert re.search(said, result.warning) if said else result.warning == ""
    assert "explained worse" not in result.warning
    assert result_of(make, state_range=torch.tensor([limits]).repeat(states, 1)).warning == ""  # ranges not learnt


def test_both_warnings_are_one_sentence():
    warning = result_of(synthetic.laptop, state_range=torch.tensor([[0.0, 0.9]]), unlike=0.995).warning
    assert "well outside what training showed and explained worse than 99% of the training clouds: it may be" in warning


def test_parts_and_joints_are_those_of_the_json():
    for make in OBJECTS:
        result = result_of(make)
        content = result.to_dict()
        json.dumps(content)
        for part, told in zip(result.parts, content["parts"], strict=True):
            assert (part.id, part.parent, part.num_points) == (told["id"], told["parent"], told["num_points"])
            np.testing.assert_array_equal(part.pose, told["pose"])
        for joint, told in zip(result.joints, content["joints"], strict=True):
            for name in ("name", "type", "parent", "child", "state"):
                assert getattr(joint, name) == told[name]
            for name in ("axis", "pivot", "limits"):
                np.testing.assert_array_equal(getattr(joint, name), told[name])


def test_it_is_exported_in_the_formats_that_are_asked_for(tmp_path):
    files = result_of(synthetic.laptop).export(tmp_path / "new" / "folder", ["json", "clouds"])
    assert {file.name for file in files} == {"prediction.json", "parts.ply", "reconstruction.ply"}
    assert all(file.is_file() for file in files)


def test_it_is_shown_in_one_line_without_arrays():
    shown = repr(result_of(synthetic.laptop))
    assert "joint_0 revolute 1 on 0 at 68.8°" in shown and "tensor" not in shown and "\n" not in shown
