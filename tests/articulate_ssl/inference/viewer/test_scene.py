import numpy as np
import pytest
import synthetic_predictions as synthetic
import torch
from scan_predictions import CENTER, OBJECTS, SCALE, result_of

from articulate_ssl.inference.articulation import articulate, canonical_object
from articulate_ssl.inference.pictures.viewpoint import level_frame
from articulate_ssl.inference.viewer import scene as viewer_scene
from articulate_ssl.inference.viewer.scene import scene_of


@pytest.mark.parametrize("make", OBJECTS)
def test_meshes_are_posed_as_the_object_is_articulated(make):
    result = result_of(make)
    (hypothesis,) = scene_of(result).hypotheses
    states = [0.1 * (j + 1) for j in range(len(hypothesis.joints))]
    poses = torch.from_numpy(hypothesis.poses(states))
    shapes = canonical_object(result.prediction)[0]
    moved = shapes @ poses[:, :3, :3].mT + poses[:, None, :3, 3]
    np.testing.assert_allclose(moved, articulate(result.prediction, torch.tensor(states))[0], atol=1e-9)
    for mesh, shape in zip(hypothesis.meshes, shapes.numpy(), strict=True):
        np.testing.assert_allclose(mesh.bounds, [shape.min(axis=0), shape.max(axis=0)], atol=1e-9)


def test_limits_hold_the_predicted_state():
    (joint,) = scene_of(result_of(synthetic.laptop)).hypotheses[0].joints
    assert joint.lower == pytest.approx(-0.1)
    assert joint.upper == joint.state == pytest.approx(1.2)


def test_the_rival_is_the_second_hypothesis_and_colours_the_scan_in_its_own_way():
    rival, _ = synthetic.laptop(seed=0)
    # The same laptop with lid and base in each other's place.
    swapped = type(rival)(**{**vars(rival), "part_pose": rival.part_pose.flip(1)})
    scene = scene_of(result_of(synthetic.laptop, rival=swapped, probability=0.87))
    best, other = scene.hypotheses
    assert (best.confidence, other.confidence) == ("87% sure", "at most 13%")
    assert (best.part_id != other.part_id).mean() > 0.9


def test_without_a_rival_or_a_probability_nothing_is_made_up():
    assert scene_of(result_of(synthetic.laptop)).hypotheses[0].confidence == "confidence unknown"
    best, rival = scene_of(result_of(synthetic.laptop, rival=synthetic.laptop(seed=2)[0])).hypotheses
    assert (best.confidence, rival.confidence) == ("explains the scan 40% better", "less likely")


@pytest.mark.parametrize(("unlike", "warned"), [(None, False), (0.5, False), (0.99, True)])
def test_a_scan_unlike_the_training_is_warned_about(unlike, warned):
    result = result_of(synthetic.laptop, state_range=torch.tensor([[0.5, 1.5]]), unlike=unlike)
    assert bool(scene_of(result).warning) == warned


def test_a_dense_scan_is_thinned_with_its_parts(monkeypatch):
    monkeypatch.setattr(viewer_scene, "MAX_SHOWN_POINTS", 100)
    result = result_of(synthetic.laptop)
    scene = scene_of(result)
    assert len(scene.points) == len(scene.hypotheses[0].part_id) == 100
    assert scene.num_points == len(result.cloud) == 512
    part_at = dict(zip(map(tuple, result.cloud), result.part_id, strict=True))
    assert [part_at[tuple(point)] for point in scene.points] == scene.hypotheses[0].part_id.tolist()


def test_the_first_view_is_that_of_the_pictures_in_the_frame_of_the_scan():
    result = result_of(synthetic.laptop)
    level = scene_of(result).level
    np.testing.assert_allclose(level @ level.T, np.eye(3), atol=1e-6)
    canonical = level @ result.prediction.base_pose[0, :3, :3].numpy()
    np.testing.assert_allclose(canonical, level_frame(result.prediction, result.limits), atol=1e-6)


def test_points_are_shown_about_the_origin():
    scene = scene_of(result_of(synthetic.laptop))
    assert np.abs((scene.points - scene.center) / scene.scale).max() < 1.5
    np.testing.assert_allclose(scene.center, CENTER)
    assert scene.scale == SCALE
