import json
import math
from dataclasses import replace

import pytest
import roma
import torch
from articulated_world import CHAIN, STAR, articulated_labels, disguise, part_turn

from articulate_ssl.baselines.perfect_oracle import perfect_oracle
from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from articulate_ssl.metrics.calibration import (
    Calibration,
    calibrate,
    chordal_mean,
    fit_states,
    match_joints,
    ransac,
)
from articulate_ssl.metrics.functional import rotation_error


@pytest.mark.parametrize("num_parts", [1, 2, 3, 4])
def test_slots_are_assigned_to_parts_and_inliers_are_all(num_parts):
    labels = articulated_labels(num_parts=num_parts)
    for seed in range(3):
        prediction, slot_of_part = disguise(perfect_oracle(labels), seed)
        calibration = calibrate(prediction, labels)
        assert torch.equal(calibration.slot_of_part, slot_of_part)
        assert torch.equal(calibration.part_of_slot[slot_of_part], torch.arange(num_parts))
        assert calibration.rotation_inliers.tolist() == calibration.center_inliers.tolist() == [1.0] * num_parts


def test_assignment_is_by_iou_even_if_one_slot_takes_most_points():
    labels = articulated_labels(num_parts=2)
    truth = perfect_oracle(labels)
    greedy = truth.part_id.clone()
    greedy[:, :20] = 0
    calibration = calibrate(replace(truth, part_id=greedy), labels)
    assert calibration.slot_of_part.tolist() == [0, 1]


@pytest.mark.parametrize("tree", [CHAIN, STAR])
def test_joints_are_matched_by_the_parts_they_connect(tree):
    labels = articulated_labels(num_parts=4, tree=tree)
    prediction, slot_of_part = disguise(perfect_oracle(labels), seed=3)
    joint, orientation = match_joints(
        prediction, slot_of_part.argsort(), labels["joint_parent"][0], labels["joint_child"][0]
    )
    for j in range(3):
        pair = {labels["joint_parent"][0, j].item(), labels["joint_child"][0, j].item()}
        n = joint[0, j]
        parent, child = prediction.joint_parent[0, n], prediction.joint_child[0, n]
        found = (slot_of_part.argsort()[parent].item(), slot_of_part.argsort()[child].item())
        assert set(found) == pair
        assert orientation[0, j] == (1 if found[0] == labels["joint_parent"][0, j] else -1)


def test_a_wrong_tree_still_gives_every_labelled_joint_a_network_joint():
    labels = articulated_labels(num_parts=4, tree=CHAIN)
    star = perfect_oracle(articulated_labels(num_parts=4, tree=STAR))
    joint, _ = match_joints(star, torch.arange(4), labels["joint_parent"][0], labels["joint_child"][0])
    assert torch.equal(joint.sort(dim=1).values, torch.arange(3).expand(24, 3))
    assert (joint[:, 0] == 0).all()  # 0-1 is in both trees


def test_residual_rotation_survives_forty_percent_of_flips():
    labels = articulated_labels(clouds=50, num_parts=2)
    flipped = torch.where(torch.arange(50) % 5 < 2, 180.0, 0.0)
    calibration = calibrate(part_turn(perfect_oracle(labels), flipped, part=1), labels)
    error = rotation_error(calibration.residual_rotation, torch.eye(3, dtype=torch.float64))
    assert error.rad2deg().max() < 0.01
    assert calibration.rotation_inliers.tolist() == pytest.approx([1.0, 0.6])


def test_residual_center_survives_thirty_percent_of_outliers():
    labels = articulated_labels(clouds=50, num_parts=2)
    truth = perfect_oracle(labels)
    pose = truth.part_pose.clone()
    pose[:15, 0, :3, 3] += 0.5
    calibration = calibrate(replace(truth, part_pose=pose), labels)
    assert calibration.residual_center.norm(dim=-1).max() < 1e-6
    assert calibration.center_inliers.tolist() == pytest.approx([0.7, 1.0])


def test_ransac_is_deterministic_and_refits_on_inliers():
    generator = torch.Generator().manual_seed(0)
    noise = roma.rotvec_to_rotmat(0.02 * torch.randn(100, 3, generator=generator, dtype=torch.float64))
    wild = roma.random_rotmat(40, dtype=torch.float64)
    samples = torch.cat([noise, wild])
    runs = [
        ransac(samples, chordal_mean, rotation_error, math.radians(5), torch.Generator().manual_seed(1))
        for _ in range(2)
    ]
    assert torch.equal(runs[0][0], runs[1][0])
    # 0.02 rad per axis over ten is 0.2 degrees; the mean of all samples is much farther off.
    assert rotation_error(runs[0][0], torch.eye(3, dtype=torch.float64)).rad2deg() < 0.6


def ransac_naive(samples, draws, threshold):
    """One hypothesis after another."""
    best, most = None, -1
    for draw in draws:
        hypothesis = chordal_mean(samples[draw][None])[0]
        inlier = torch.stack([rotation_error(hypothesis, s) < threshold for s in samples])
        if inlier.sum() > most:
            best, most = inlier, inlier.sum()
    return chordal_mean(samples[best][None])[0]


def test_ransac_equals_naive(monkeypatch):
    monkeypatch.setattr("articulate_ssl.metrics.calibration.HYPOTHESES", 20)
    generator = torch.Generator().manual_seed(0)
    samples = roma.rotvec_to_rotmat(0.1 * torch.randn(15, 3, generator=generator, dtype=torch.float64))
    draws = torch.rand(20, 15, generator=torch.Generator().manual_seed(5)).argsort(dim=1)[:, :5]
    found, _ = ransac(samples, chordal_mean, rotation_error, 0.1, torch.Generator().manual_seed(5))
    torch.testing.assert_close(found, ransac_naive(samples, draws, 0.1))


@pytest.mark.parametrize("count", [1, 3])
def test_fewer_clouds_than_a_ransac_sample(count):
    labels = articulated_labels(clouds=count, num_parts=2)
    prediction, _ = disguise(perfect_oracle(labels))
    assert calibrate(prediction, labels).rotation_inliers.tolist() == [1.0, 1.0]


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("offset", [0.0, 2.0, math.pi])
def test_state_sign_and_offset(sign, offset):
    target = torch.linspace(0.1, 1.7, 60, dtype=torch.float64)[:, None].repeat(1, 2)
    predicted = sign * (target - offset)
    predicted[::4] += 3.0  # a quarter of outliers
    found_sign, found_offset = fit_states(predicted, target, torch.tensor([True, False]))
    assert found_sign.tolist() == [sign, sign]
    assert math.cos(found_offset[0].item() - offset) == pytest.approx(1, abs=1e-9)
    assert found_offset[1].item() == pytest.approx(offset, abs=1e-9)


def test_axis_sign_is_recorded():
    labels = articulated_labels(num_parts=2)
    truth = perfect_oracle(labels)
    assert calibrate(truth, labels).axis_sign.tolist() == [1.0]
    opposite = calibrate(replace(truth, joint_axis=-truth.joint_axis, joint_state=-truth.joint_state), labels)
    assert opposite.axis_sign.tolist() == [-1.0]
    assert opposite.state_sign.tolist() == [-1.0]


@pytest.mark.parametrize("num_parts", [1, 3])
def test_json_round_trip(num_parts):
    labels = articulated_labels(num_parts=num_parts, joint_types=(REVOLUTE, PRISMATIC)[: num_parts - 1])
    calibration = calibrate(disguise(perfect_oracle(labels))[0], labels)
    again = Calibration.from_dict(json.loads(json.dumps(calibration.to_dict())))
    for name, value in vars(calibration).items():
        assert torch.equal(getattr(again, name), value), name
        assert getattr(again, name).dtype == value.dtype, name


def test_from_dict_refuses_other_fields():
    with pytest.raises(ValueError, match="slot_of_part"):
        Calibration.from_dict({"slots": [0]})


def test_bad_input_is_named():
    labels = articulated_labels(num_parts=2)
    truth = perfect_oracle(labels)
    with pytest.raises(ValueError, match="dense_part_id"):
        calibrate(truth, {k: v for k, v in labels.items() if k != "dense_part_id"})
    with pytest.raises(ValueError, match="part_pose"):
        calibrate(truth, articulated_labels(num_parts=3))
    with pytest.raises(ValueError, match=r"part_pose for cloud 3"):
        pose = truth.part_pose.clone()
        pose[3, 1, 0, 0] = torch.nan
        calibrate(replace(truth, part_pose=pose), labels)
    with pytest.raises(ValueError, match="one category"):
        calibrate(truth, labels | {"joint_type": torch.arange(24)[:, None] % 2})
    with pytest.raises(ValueError, match="at least one"):
        calibrate(truth[:0], {k: v[:0] for k, v in labels.items()})
