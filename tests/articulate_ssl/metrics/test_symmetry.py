import time
from dataclasses import replace

import pytest
import roma
import torch
from articulated_world import articulated_labels, disguise
from symmetric_world import BODY, DOUBLE, HANDLE, TURNTABLE, box_labels, turned_about

from articulate_ssl.baselines.perfect_oracle import perfect_oracle
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.metrics import ArticulatedPoseMetrics, calibrate
from articulate_ssl.metrics.functional import rotation_error
from articulate_ssl.metrics.symmetry import measured_symmetries, pool, rest_clouds, symmetric_rotation_error

MIDDLE = (0.0, 0.2, 0.0)
HALF_TURN = turned_about("y", 180)


def symmetries_of(labels: dict) -> torch.Tensor:
    return measured_symmetries(pool(rest_clouds(labels), labels["joint_type"][0]))


def as_sets(rotations: torch.Tensor) -> set[tuple]:
    return {tuple(r.round().int().flatten().tolist()) for r in rotations}


def turned(prediction: Prediction, rotation: torch.Tensor, parts: slice = slice(None)) -> Prediction:
    """Every part's pose times S; canonical spaces of the oracle have the object's axes."""
    pose = prediction.part_pose.double().clone()
    pose[:, parts] = pose[:, parts] @ se3(rotation.double(), torch.zeros(3, dtype=DOUBLE))
    return replace(prediction, part_pose=pose.float())


def score(prediction: Prediction, labels: dict) -> dict:
    """In a network's own terms: calibration must bring slots and canonical spaces back."""
    prediction, truth = (disguise(p, seed=3)[0] for p in (prediction, perfect_oracle(labels)))
    metrics = ArticulatedPoseMetrics(calibrate(truth, labels), replicates=20)
    for half in (slice(0, 7), slice(7, None)):
        metrics.update(prediction[half], {name: value[half] for name, value in labels.items()})
    return metrics.compute()


@pytest.mark.parametrize(
    ("size", "count"), [((0.7, 0.5, 0.3), 4), ((0.5, 0.5, 0.3), 8), ((0.5, 0.5, 0.5), 24), ((0.7, 0.5, 0.01), 4)]
)
def test_boxes_have_the_rotations_of_their_shape(size, count):
    labels = box_labels([[((0.3, 0.2, -0.1), size)]], instances=1, clouds=8)
    found = symmetries_of(labels)
    assert len(found) == count
    assert torch.equal(found[0], torch.eye(3, dtype=DOUBLE))
    extent = torch.tensor(size, dtype=DOUBLE)
    for rotation in found:
        torch.testing.assert_close((rotation @ torch.diag(extent) @ rotation.T).diagonal(), extent)


def test_a_half_turn_that_keeps_parts_and_hinge_is_the_one_symmetry():
    found = symmetries_of(box_labels([[BODY], [TURNTABLE]], (MIDDLE,)))
    assert as_sets(found) == as_sets(torch.stack([torch.eye(3, dtype=DOUBLE), HALF_TURN]))


@pytest.mark.parametrize("points", [4096, 8192])
def test_a_small_handle_breaks_the_symmetry(points):
    labels = box_labels([[BODY, HANDLE], [TURNTABLE]], (MIDDLE,), dense=points)
    assert len(symmetries_of(labels)) == 1


def test_handles_on_both_sides_restore_it():
    (x, y, z), size = HANDLE
    labels = box_labels([[BODY, HANDLE, ((x, y, -z), size)], [TURNTABLE]], (MIDDLE,))
    assert len(symmetries_of(labels)) == 2


def test_a_hinge_at_the_edge_breaks_what_surfaces_allow():
    """The closed laptop without keys: two plates on each other, and the hinge behind."""
    plates = [[((0.0, 0.0, 0.0), (0.6, 0.04, 0.4))], [((0.0, 0.05, 0.0), (0.6, 0.04, 0.4))]]
    assert len(symmetries_of(box_labels(plates, ((0.0, 0.05, 0.0),)))) == 2
    assert len(symmetries_of(box_labels(plates, ((0.0, 0.0, -0.2),), axis=(1.0, 0.0, 0.0)))) == 1


def test_equal_parts_do_not_change_places():
    def door(x: float) -> list:
        return [((x, 0.0, 0.0), (0.05, 0.3, 0.2))]

    labels = box_labels([[BODY], door(-0.4), door(0.4)], ((-0.4, 0.0, 0.0), (0.4, 0.0, 0.0)))
    # About x both doors stay; about y and z each would become the other.
    assert as_sets(symmetries_of(labels)) == as_sets(torch.stack([torch.eye(3, dtype=DOUBLE), turned_about("x", 180)]))


def test_a_mirror_image_is_no_rotation():
    """Two equal bars on opposite faces, one up, one down and off the middle: chiral, with one half turn about z."""
    body = ((0.0, 0.0, 0.0), (0.6, 0.4, 0.5))
    left, right = ((-0.32, 0.1, 0.15), (0.04, 0.1, 0.1)), ((0.32, -0.1, 0.15), (0.04, 0.1, 0.1))
    mirrored = ((0.32, 0.1, 0.15), (0.04, 0.1, 0.1))
    assert as_sets(symmetries_of(box_labels([[body, left, right]]))) == as_sets(
        torch.stack([torch.eye(3, dtype=DOUBLE), turned_about("z", 180)])
    )
    assert len(symmetries_of(box_labels([[body, left, mirrored]]))) == 1


def test_views_of_unequal_scale_give_the_same_symmetries():
    labels = box_labels([[BODY], [TURNTABLE]], (MIDDLE,))
    scale = torch.linspace(0.5, 2, 16)
    honest = labels | {"scale": scale}
    for name in ("dense_points", "part_center", "joint_pivot"):
        honest[name] = labels[name] / scale[:, None, None]
    honest["part_pose"] = labels["part_pose"].clone()
    honest["part_pose"][..., :3, 3] /= scale[:, None, None]
    assert torch.equal(symmetries_of(honest), symmetries_of(labels))


def test_clouds_too_coarse_to_tell_grant_nothing():
    assert len(symmetries_of(box_labels([[BODY], [TURNTABLE]], (MIDDLE,), dense=200))) == 1
    without_points = box_labels([[BODY], [TURNTABLE]], (MIDDLE,))
    without_points["dense_part_id"][:] = 0
    assert len(symmetries_of(without_points)) == 1


def test_clouds_that_share_their_points_are_not_taken_for_resamplings():
    """All clouds show the same points: distances between them would be 0, and no turn could do as well."""
    labels = box_labels([[BODY], [TURNTABLE]], (MIDDLE,), clouds=1, dense=16384)
    same = {name: value.expand(4, *value.shape[1:]) for name, value in labels.items()}
    rotation = roma.rotvec_to_rotmat(torch.randn(4, 3, generator=torch.Generator().manual_seed(0)))
    same |= {name: same[name] @ rotation.mT for name in ("dense_points", "joint_axis", "joint_pivot")}
    same["part_pose"] = se3(rotation, torch.zeros(3))[:, None] @ same["part_pose"]
    assert len(symmetries_of(same)) == 2


def test_the_measurement_is_deterministic_and_cheap():
    labels = box_labels([[((0.0, 0.0, 0.0), (0.5, 0.5, 0.5))]], clouds=40, instances=1)
    start = time.perf_counter()
    first = symmetries_of(labels)
    # 0.6 s seen for the worst case, all 24 of a cube on one core; typical objects take hundredths.
    assert time.perf_counter() - start < 5
    assert torch.equal(first, symmetries_of(labels))


def test_one_symmetry_serves_all_parts():
    wrong = torch.stack([HALF_TURN, torch.eye(3, dtype=DOUBLE)])[None]
    both = torch.stack([HALF_TURN, HALF_TURN])[None]
    known = torch.stack([torch.eye(3, dtype=DOUBLE), HALF_TURN])
    assert symmetric_rotation_error(both, known).rad2deg().tolist()[0] == pytest.approx([0, 0])
    assert symmetric_rotation_error(wrong, known).rad2deg().sum().item() == pytest.approx(180)


def test_the_least_error_equals_a_loop():
    symmetries = symmetries_of(box_labels([[((0.0, 0.0, 0.0), (0.5, 0.5, 0.3))]], instances=1, clouds=8))
    g = torch.Generator().manual_seed(0)
    true, predicted = (roma.special_procrustes(torch.randn(20, 3, 3, 3, generator=g, dtype=DOUBLE)) for _ in range(2))
    error = symmetric_rotation_error(true.mT @ predicted, symmetries)
    for b in range(20):
        options = [rotation_error(predicted[b], true[b] @ s) for s in symmetries]
        torch.testing.assert_close(error[b], min(options, key=lambda e: e.mean()))


# What reports say


def test_a_perfect_oracle_scores_zero_and_a_turned_one_zero_modulo_symmetry_only():
    labels = box_labels([[BODY], [TURNTABLE]], (MIDDLE,))
    truth = perfect_oracle(labels)
    perfect, half = score(truth, labels), score(turned(truth, HALF_TURN), labels)
    for result in (perfect, half):
        assert (result["instances"], result["symmetric_instances"]) == (2, 2)
        assert result["r_err_sym_deg"]["mean"] < 1e-3
        assert [part["mean"] < 1e-3 for part in result["r_err_sym_deg"]["parts"]] == [True, True]
    assert perfect["r_err_deg"]["mean"] < 1e-3
    assert half["r_err_deg"]["mean"] == pytest.approx(180, abs=1e-3)
    assert half["flip_rate"]["mean"] == 1


@pytest.mark.parametrize("wrong", [turned_about("x", 180), turned_about("z", 180), turned_about("y", 90)])
def test_a_turn_that_is_no_symmetry_is_not_forgiven(wrong):
    labels = box_labels([[BODY], [TURNTABLE]], (MIDDLE,))
    result = score(turned(perfect_oracle(labels), wrong), labels)
    assert result["r_err_sym_deg"]["mean"] > 89


def test_one_turned_part_is_not_forgiven():
    labels = box_labels([[BODY], [TURNTABLE]], (MIDDLE,))
    result = score(turned(perfect_oracle(labels), HALF_TURN, slice(0, 1)), labels)
    assert result["r_err_sym_deg"]["mean"] == pytest.approx(90, abs=1e-3)


def test_a_nearly_symmetric_object_keeps_its_error():
    labels = box_labels([[BODY, HANDLE], [TURNTABLE]], (MIDDLE,))
    result = score(turned(perfect_oracle(labels), HALF_TURN), labels)
    assert result["symmetric_instances"] == 0
    assert result["r_err_sym_deg"] == result["r_err_deg"]
    assert result["r_err_sym_deg"]["mean"] == pytest.approx(180, abs=1e-3)


def test_only_symmetric_instances_are_forgiven():
    plain, odd = ([[BODY], [TURNTABLE]], [[BODY, HANDLE], [TURNTABLE]])
    first, second = (box_labels(parts, (MIDDLE,), clouds=8, instances=1) for parts in (plain, odd))
    second["instance"] = second["instance"] + 5
    labels = {name: torch.cat([first[name], second[name]]) for name in first}
    result = score(turned(perfect_oracle(labels), HALF_TURN), labels)
    assert (result["instances"], result["symmetric_instances"]) == (2, 1)
    assert result["r_err_sym_deg"]["mean"] == pytest.approx(90, abs=1e-3)


def test_a_constant_predictor_scores_chance():
    """126.5 degrees unfolded (pi/2 + 2/pi radians); modulo a half turn, the mean of a simulation."""
    # At rest all parts of a cloud have one rotation, so a constant one is off by the same angle for each.
    labels = box_labels([[BODY], [TURNTABLE]], (MIDDLE,), clouds=400, instances=1, dense=128, states=0.0)
    truth = perfect_oracle(labels)
    result = score(replace(truth, part_pose=truth.part_pose[:1].expand_as(truth.part_pose)), labels)
    assert result["symmetric_instances"] == 1
    assert result["r_err_deg"]["mean"] == pytest.approx(126.5, abs=5)
    g = torch.Generator().manual_seed(0)
    random = roma.special_procrustes(torch.randn(20000, 3, 3, generator=g, dtype=DOUBLE))
    both = torch.stack([rotation_error(random, s.expand_as(random)) for s in (torch.eye(3, dtype=DOUBLE), HALF_TURN)])
    assert result["r_err_sym_deg"]["mean"] == pytest.approx(both.amin(0).rad2deg().mean().item(), abs=5)
    assert result["above_30_rate"]["mean"] > 0.95


def test_objects_in_general_position_have_no_symmetry():
    labels = articulated_labels(num_parts=3, clouds=8, dense=4096)
    result = score(turned(perfect_oracle(labels), HALF_TURN), labels)
    assert result["symmetric_instances"] == 0
    assert result["r_err_sym_deg"] == result["r_err_deg"]
