import socket
import urllib.request

import numpy as np
import pytest
import synthetic_predictions as synthetic
import torch
from scan_predictions import OBJECTS, result_of
from viser.transforms import SO3

from articulate_ssl.inference.articulation import part_motion
from articulate_ssl.inference.viewer import live
from articulate_ssl.inference.viewer.live import LiveViewer


@pytest.fixture
def show():
    viewers = []

    def show(make, **changes):
        result = result_of(make, **changes)
        viewers.append(LiveViewer(result, port=0))
        return viewers[-1], result

    yield show
    for viewer in viewers:
        viewer.stop()


def pose_of(node, scene) -> np.ndarray:  # [4, 4] canonical object space -> scan
    pose = np.eye(4)
    pose[:3, :3] = SO3(np.asarray(node.wxyz)).as_matrix()
    pose[:3, 3] = np.asarray(node.position) * scene.scale + scene.center
    return pose


def expected(prediction, states) -> np.ndarray:
    return (prediction.base_pose[0] @ part_motion(prediction, torch.tensor(states))[0]).numpy()


@pytest.mark.parametrize("make", OBJECTS)
def test_sliders_start_at_the_predicted_states_and_move_the_parts(show, make):
    viewer, result = show(make)
    np.testing.assert_allclose(viewer.states(), result.prediction.joint_state[0])
    for j, slider in enumerate(viewer.sliders):
        slider.value = slider.min + 0.3 * (slider.max - slider.min)
        states = viewer.states()
        joint = viewer.hypothesis.joints[j]
        assert states[j] == pytest.approx(joint.lower + 0.3 * (joint.upper - joint.lower), abs=2e-3)
        poses = expected(result.prediction, states)
        for node, pose in zip(viewer.part_nodes, poses, strict=True):
            np.testing.assert_allclose(pose_of(node, viewer.scene), pose, atol=1e-5)
        for node, parent in zip(viewer.axis_nodes, result.prediction.joint_parent[0].tolist(), strict=True):
            np.testing.assert_allclose(pose_of(node, viewer.scene), poses[parent], atol=1e-5)


def test_a_hinge_is_moved_in_degrees_and_within_its_limits(show):
    viewer, _ = show(synthetic.laptop)
    (slider,) = viewer.sliders
    assert slider.value == pytest.approx(np.degrees(1.2))
    slider.value = slider.min
    assert viewer.states() == [pytest.approx(-0.1)]
    slider.value = slider.max
    assert viewer.states() == [pytest.approx(1.2)]


def test_the_button_shows_the_rival_and_then_the_best_again(show):
    rival = synthetic.laptop(angle=0.7, seed=3)[0]
    viewer, result = show(synthetic.laptop, rival=rival, probability=0.87)
    assert viewer.next_button.visible
    best = viewer.hypothesis
    viewer.next_button.value = True  # what a click sets
    assert viewer.hypothesis is viewer.scene.hypotheses[1]
    assert viewer.states() == [pytest.approx(0.7)]
    for node, pose in zip(viewer.part_nodes, expected(result.rival, [0.7]), strict=True):
        np.testing.assert_allclose(pose_of(node, viewer.scene), pose, atol=1e-5)
    viewer.next_button.value = True
    assert viewer.hypothesis is best


def test_without_a_rival_there_is_no_button(show):
    assert not show(synthetic.laptop)[0].next_button.visible


def test_a_browser_is_answered_until_the_viewer_is_stopped(show):
    viewer, _ = show(synthetic.laptop)
    with urllib.request.urlopen(viewer.url) as answer:
        assert b"<html" in answer.read(2000)
    viewer.stop()
    with pytest.raises(OSError):
        urllib.request.urlopen(viewer.url, timeout=5)


def test_two_viewers_do_not_share_a_port(show):
    assert show(synthetic.laptop)[0].url != show(synthetic.laptop)[0].url


def test_behind_the_last_port_there_is_none(monkeypatch):
    with socket.socket() as taken:
        taken.bind((live.HOST, 0))
        taken.listen()
        port = taken.getsockname()[1]
        monkeypatch.setattr(live, "LAST_PORT", port)
        with pytest.raises(OSError, match=f"no port from {port} to {port} is free.*or 0 for any"):
            LiveViewer(result_of(synthetic.laptop), port)


def test_the_camera_looks_at_the_front_from_above(show):
    viewer, _ = show(synthetic.laptop)
    camera = viewer._server.initial_camera
    towards = viewer.scene.level @ (camera.position - camera.look_at)
    assert towards[1] > 0 and towards[2] > abs(towards[0])
