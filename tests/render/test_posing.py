"""Articulation states, rotations, and labels that agree with the geometry."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from objects import box_chain
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from articulate_ssl.geometry.screw import screw_motion
from render.posing import pose_labels, sample_rotation, sample_states


def test_states_cover_every_joint_range_evenly():
    states = sample_states([(0.1, 1.5), (-2.0, -1.0)], 100, np.random.default_rng(0))
    assert states.shape == (100, 2)
    for column, (lower, upper) in zip(states.T, [(0.1, 1.5), (-2.0, -1.0)], strict=True):
        share = np.sort((column - lower) / (upper - lower))
        assert np.all(np.floor(share * 100) == np.arange(100)), "one state in every hundredth of the range"
    assert abs(np.corrcoef(states.T)[0, 1]) < 0.3


def test_rotations_are_uniform():
    """The angle of a uniform rotation has density (1 - cos) / pi."""
    rng = np.random.default_rng(0)
    angle = [Rotation.from_matrix(sample_rotation(rng)).magnitude() for _ in range(400)]
    assert kstest(angle, lambda a: (a - np.sin(a)) / np.pi).pvalue > 0.01


@pytest.fixture(params=[0, 1])
def posed(request):
    """An object, states, and everything `pose_labels` takes, with its result."""
    rng = np.random.default_rng(request.param)
    chain = box_chain()
    states = rng.uniform([0, -1], [0.4, 0.5])
    rotation, translation, center, scale = sample_rotation(rng), rng.normal(size=3), rng.normal(size=3), 0.7
    motion = chain.part_motion(states)
    labels = pose_labels(chain, states, motion, rotation, translation, center, scale)
    return chain, states, rotation, translation, center, scale, labels


def test_part_pose_takes_rest_points_to_the_normalised_cloud(posed):
    chain, states, rotation, translation, center, scale, labels = posed
    for mesh, motion, pose in zip(chain.meshes, chain.part_motion(states), labels["part_pose"], strict=True):
        camera = trimesh.transform_points(mesh.vertices, motion) @ rotation.T + translation
        np.testing.assert_allclose(
            trimesh.transform_points(mesh.vertices / scale, pose), (camera - center) / scale, atol=1e-12
        )


def test_part_centers_are_those_of_the_rest_boxes(posed):
    *_, scale, labels = posed
    np.testing.assert_allclose(labels["part_center"][0] * scale, [0, 0.15, 0], atol=1e-12)
    np.testing.assert_allclose(labels["part_center"][2] * scale, [0, 0.15, 0.32], atol=1e-12)


@pytest.mark.parametrize("joint_index", [0, 1])
def test_moving_a_part_about_its_labelled_joint_gives_its_pose_in_the_other_state(posed, joint_index):
    chain, states, rotation, translation, center, scale, labels = posed
    change = 0.3
    other = states.copy()
    other[joint_index] += change
    joint = chain.joints[joint_index]
    difference = change / scale if joint.type else change
    screw = screw_motion(
        torch.from_numpy(labels["joint_axis"][joint_index]),
        torch.from_numpy(labels["joint_pivot"][joint_index]),
        torch.tensor(difference, dtype=torch.float64),
        joint.type,
    ).numpy()
    after = pose_labels(chain, other, chain.part_motion(other), rotation, translation, center, scale)
    np.testing.assert_allclose(screw @ labels["part_pose"][joint.child], after["part_pose"][joint.child], atol=1e-12)
    np.testing.assert_allclose((after["joint_state"] - labels["joint_state"])[joint_index], difference)
