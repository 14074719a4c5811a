import itertools
from dataclasses import replace

import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from articulated_world import CHAIN, PRISMATIC, REVOLUTE, STAR, articulated_labels, disguise, part_turn

from articulate_ssl.baselines.perfect_oracle import perfect_oracle
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.metrics import ArticulatedPoseMetrics, calibrate
from articulate_ssl.metrics.articulated_pose import PER_CLOUD, PER_JOINT, PER_PART

PRIMARY_ERRORS = ("r_err_deg", "t_err", "flip_rate", "axis_err_deg", "pivot_err", "state_err", "chamfer_l1")


def part_of(labels: dict, index) -> dict:
    return {name: value[index] for name, value in labels.items()}


def score(
    prediction: Prediction, labels: dict, train: Prediction | None = None, train_labels: dict | None = None
) -> dict:
    metrics = ArticulatedPoseMetrics(calibrate(train or prediction, train_labels or labels), replicates=50)
    metrics.update(prediction, labels)
    return metrics.compute()


@pytest.mark.parametrize("num_parts", [1, 2, 3, 4])
@pytest.mark.parametrize("tree", [CHAIN, STAR])
@pytest.mark.parametrize("joint_type", [REVOLUTE, PRISMATIC])
def test_ground_truth_in_zero_error_out(num_parts, tree, joint_type):
    """In the network's own terms: permuted slots and joints, arbitrary canonical spaces, axis directions and zeros."""
    types = (joint_type,) * (num_parts - 1)
    train_labels = articulated_labels(num_parts=num_parts, tree=tree, joint_types=types, seed=0)
    test_labels = articulated_labels(clouds=12, num_parts=num_parts, tree=tree, joint_types=types, seed=1)
    for seed in range(2):
        train, test = (disguise(perfect_oracle(labels), seed)[0] for labels in (train_labels, test_labels))
        result = score(test, test_labels, train, train_labels)
        assert result["seg_miou"]["mean"] == 1.0
        assert result["samples"] == 12
        assert result["failures"] == 0
        for name in PRIMARY_ERRORS:
            if num_parts == 1 and name in PER_JOINT:
                assert result[name] == {"mean": None, "median": None, "ci95": None, "joints": []}
            elif name == "pivot_err" and joint_type == PRISMATIC:
                assert result[name]["mean"] is None
            else:
                # Worst value seen: 5e-6 degrees, from float32 labels.
                for single in [result[name], *result[name].get("parts", []), *result[name].get("joints", [])]:
                    assert single["mean"] < 2e-5
                    assert single["ci95"][0] <= single["mean"] + 1e-12


@pytest.mark.parametrize("degrees", [0.5, 29.9, 31.0, 78.0, 89.0, 91.0, 150.0, 179.5])
def test_a_known_rotation_error_comes_out_unfolded(degrees):
    labels = articulated_labels(num_parts=3)
    truth, slot_of_part = disguise(perfect_oracle(labels), seed=2)
    result = score(part_turn(truth, degrees, slot_of_part[1].item()), labels, truth, labels)
    assert result["r_err_deg"]["parts"][1]["mean"] == pytest.approx(degrees, abs=1e-3)
    assert result["r_err_deg"]["parts"][0]["mean"] == pytest.approx(0, abs=1e-3)
    assert result["r_err_deg"]["mean"] == pytest.approx(degrees / 3, abs=1e-3)
    assert result["legacy_r_err_deg"]["parts"][1]["mean"] == pytest.approx(min(degrees, 180 - degrees), abs=1e-3)
    assert result["flip_rate"]["parts"][1]["mean"] == float(degrees > 90)
    assert result["flip_rate"]["mean"] == float(degrees > 90)
    assert result["above_30_rate"]["parts"][0]["mean"] == 0
    assert result["above_30_rate"]["mean"] == result["above_30_rate"]["parts"][1]["mean"] == float(degrees > 30)


def test_flip_rate_counts_clouds_with_any_flipped_part():
    labels = articulated_labels(clouds=20, num_parts=2)
    truth = perfect_oracle(labels)
    flipped = part_turn(truth, torch.where(torch.arange(20) < 4, 170.0, 10.0), part=0)
    flipped = part_turn(flipped, torch.where(torch.arange(20) < 5, 170.0, 10.0), part=1)
    result = score(flipped, labels, truth, labels)["flip_rate"]
    assert result["mean"] == pytest.approx(0.25)
    assert [part["mean"] for part in result["parts"]] == pytest.approx([0.2, 0.25])


def test_above_30_counts_clouds_with_any_such_part():
    labels = articulated_labels(clouds=20, num_parts=2)
    truth = perfect_oracle(labels)
    off = part_turn(truth, torch.where(torch.arange(20) < 4, 78.0, 10.0), part=0)
    off = part_turn(off, torch.where(torch.arange(20) >= 17, 31.0, 29.0), part=1)
    result = score(off, labels, truth, labels)
    assert result["above_30_rate"]["mean"] == pytest.approx(7 / 20)
    assert [part["mean"] for part in result["above_30_rate"]["parts"]] == pytest.approx([4 / 20, 3 / 20])
    assert len(result["above_30_rate"]["ci95"]) == 2
    assert result["flip_rate"]["mean"] == 0


def test_a_known_displacement_comes_out():
    labels = articulated_labels(num_parts=2)
    truth, slot_of_part = disguise(perfect_oracle(labels), seed=1)
    pose = truth.part_pose.clone()
    pose[:, slot_of_part[0], :3, 3] += torch.tensor([0.03, 0.0, 0.04])
    result = score(replace(truth, part_pose=pose), labels, truth, labels)
    assert result["t_err"]["parts"][0]["mean"] == pytest.approx(0.05, abs=1e-5)
    assert result["t_err"]["mean"] == pytest.approx(0.025, abs=1e-5)
    assert result["r_err_deg"]["mean"] < 1e-3


def test_known_joint_errors_come_out():
    labels = articulated_labels(num_parts=2)
    truth = perfect_oracle(labels)
    axis = truth.joint_axis
    beside = torch.nn.functional.normalize(
        torch.linalg.cross(axis, torch.tensor([0.3, 0.4, 0.5]).expand_as(axis)), dim=-1
    )
    wrong = replace(
        truth,
        joint_axis=torch.nn.functional.normalize(axis + torch.tan(torch.deg2rad(torch.tensor(20.0))) * beside, dim=-1),
        joint_pivot=truth.joint_pivot + 0.1 * torch.linalg.cross(axis, beside),
        joint_state=truth.joint_state + torch.deg2rad(torch.tensor(7.0)) + 2 * torch.pi,
    )
    result = score(wrong, labels, truth, labels)
    assert result["axis_err_deg"]["mean"] == pytest.approx(20, abs=1e-3)
    assert result["legacy_axis_err_deg"]["mean"] == pytest.approx(20, abs=1e-3)
    assert result["pivot_err"]["mean"] == pytest.approx(0.1, abs=1e-5)
    assert result["state_err"]["mean"] == pytest.approx(7, abs=1e-3)


def test_prismatic_state_is_a_length_and_mixed_states_have_no_common_mean():
    labels = articulated_labels(num_parts=3, joint_types=(PRISMATIC, REVOLUTE))
    truth = perfect_oracle(labels)
    result = score(replace(truth, joint_state=truth.joint_state + 0.1), labels, truth, labels)["state_err"]
    assert result["mean"] is None
    assert result["joints"][0]["mean"] == pytest.approx(0.1, abs=1e-5)
    assert result["joints"][1]["mean"] == pytest.approx(5.7296, abs=1e-3)


def swap_slots(prediction: Prediction, clouds: torch.Tensor) -> Prediction:
    """Parts 0 and 1 exchanged in some clouds: segments, poses and shapes."""
    order = torch.tensor([1, 0])

    def exchanged(value: torch.Tensor) -> torch.Tensor:
        value = value.clone()
        value[clouds] = value[clouds][:, order]
        return value

    part_id = prediction.part_id.clone()
    part_id[clouds] = 1 - part_id[clouds]
    return replace(
        prediction,
        part_id=part_id,
        part_pose=exchanged(prediction.part_pose),
        part_shape=exchanged(prediction.part_shape),
    )


def test_points_count_as_they_are_labelled_or_as_the_nearest_is():
    labels = articulated_labels(clouds=6, num_parts=2)
    truth = perfect_oracle(labels)
    right = labels["dense_part_id"].long()
    exchanged = [1 - right, torch.where(torch.arange(right.shape[1]) % 2 == 0, right, 1 - right)]
    by_nearest = score(truth, labels, truth, labels)["seg_miou"]["mean"]
    found = [
        score(replace(truth, dense_part_id=d), labels, truth, labels)["seg_miou"]["mean"] for d in (right, *exchanged)
    ]
    assert found[0] == 1 >= by_nearest and found[1] == 0 and 0.2 < found[2] < 0.5
    with pytest.raises(ValueError, match="dense_points"):
        score(replace(truth, dense_part_id=right[:, 1:]), labels, truth, labels)


def test_exchanged_parts_are_punished_and_only_legacy_columns_forgive():
    labels = articulated_labels(clouds=20, num_parts=2)
    truth = perfect_oracle(labels)
    result = score(swap_slots(truth, torch.arange(20) < 5), labels, truth, labels)
    assert result["seg_miou"]["mean"] == pytest.approx(0.75)
    assert result["legacy_seg_miou"]["mean"] == 1.0
    assert result["t_err"]["mean"] > 0.05
    assert result["legacy_t_err"]["mean"] < 1e-5
    assert result["r_err_deg"]["mean"] > 1
    assert result["legacy_r_err_deg"]["mean"] < 1e-3


def test_shuffled_clouds_score_at_chance():
    labels = articulated_labels(clouds=200, num_parts=2, dense=60)
    truth = perfect_oracle(labels)
    shuffled = replace(truth, part_pose=truth.part_pose[torch.arange(200) - 1])
    result = score(shuffled, labels, truth, labels)
    assert 115 < result["r_err_deg"]["mean"] < 138
    assert 38 < result["legacy_r_err_deg"]["mean"] < 52


@pytest.mark.parametrize("points_left", [0, 1])
def test_empty_and_one_point_segments_count_with_their_errors(points_left):
    labels = articulated_labels(num_parts=2)
    truth = perfect_oracle(labels)
    part_id = torch.zeros_like(truth.part_id)
    part_id[:, 1 : 1 + points_left] = 1
    pose = part_turn(truth, 25.0, part=1).part_pose
    result = score(replace(truth, part_id=part_id, part_pose=pose), labels, truth, labels)
    assert result["samples"] == 24
    assert result["r_err_deg"]["parts"][1]["mean"] == pytest.approx(25, abs=1e-3)
    assert result["seg_miou"]["parts"][1]["mean"] == pytest.approx(0, abs=0.2)
    assert (result["seg_miou"]["parts"][1]["mean"] == 0) == (points_left == 0)


def test_a_part_seen_by_one_point():
    labels = articulated_labels(num_parts=2)
    labels["dense_part_id"] = torch.zeros_like(labels["dense_part_id"])
    labels["dense_part_id"][:, 1] = 1
    result = score(perfect_oracle(labels), labels)
    for name in ("r_err_deg", "t_err", "chamfer_l1"):
        assert result[name]["mean"] < 1e-6
    # Its dense neighbours, which are labelled otherwise, follow the one point.
    assert 0 < result["seg_miou"]["parts"][1]["mean"] < 1


def test_a_method_without_joints_gets_no_joint_errors():
    labels = articulated_labels(num_parts=3)
    truth = perfect_oracle(labels)
    names = [n for n in vars(truth) if n.startswith(("joint_", "canonical_"))]
    jointless = replace(truth, **{n: getattr(truth, n)[:, :0] for n in names})
    for train in (truth, jointless):
        result = score(jointless, labels, train, labels)
        for name in PER_JOINT:
            assert [result[name]["mean"], *(j["mean"] for j in result[name]["joints"])] == [None] * 3
        assert result["r_err_deg"]["mean"] < 1e-3


def test_joint_listing_may_vary_between_clouds():
    """A tree found per cloud may list the same edges in another order or direction; that is no error."""
    labels = articulated_labels(num_parts=3, tree=STAR)
    truth = perfect_oracle(labels)
    order = torch.tensor([1, 0])
    names = [n for n in vars(truth) if n.startswith(("joint_", "canonical_"))]
    odd = {n: torch.cat([getattr(truth, n)[:12], getattr(truth, n)[12:, order]]) for n in names}
    parent, child = odd["joint_parent"].clone(), odd["joint_child"].clone()
    parent[6:18], child[6:18] = odd["joint_child"][6:18], odd["joint_parent"][6:18]
    state = odd["joint_state"].clone()
    state[6:18] *= -1
    result = score(replace(truth, **odd | {"joint_parent": parent, "joint_child": child, "joint_state": state}), labels)
    for name in ("axis_err_deg", "pivot_err", "state_err"):
        assert result[name]["mean"] < 1e-3


def test_labels_of_the_test_clouds_do_not_choose_the_state_sign():
    labels = articulated_labels(num_parts=2)
    truth = perfect_oracle(labels)
    result = score(replace(truth, joint_state=-truth.joint_state), labels, truth, labels)
    assert result["state_err"]["mean"] > 10


def test_every_quantity_of_the_contract_is_there():
    result = score(perfect_oracle(labels := articulated_labels()), labels)
    assert {
        "r_err_deg",
        "t_err",
        "flip_rate",
        "axis_err_deg",
        "pivot_err",
        "state_err",
        "seg_miou",
        "chamfer_l1",
    } <= set(result)
    assert set(result) == {
        *PER_PART,
        *PER_JOINT,
        *PER_CLOUD,
        "samples",
        "failures",
        "instances",
        "symmetric_instances",
        "margin",
        "probability",
    }
    for name in (*PER_PART, *PER_JOINT, *PER_CLOUD):
        assert {"mean", "median", "ci95"} <= set(result[name])
    assert [len(result[name]["parts"]) for name in PER_PART] == [3] * len(PER_PART)
    assert [len(result[name]["joints"]) for name in PER_JOINT] == [2] * len(PER_JOINT)


def test_probabilities_are_reported_where_a_method_has_them():
    labels = articulated_labels()
    prediction = perfect_oracle(labels)
    assert score(prediction, labels)["probability"] is None
    metrics = ArticulatedPoseMetrics(calibrate(prediction, labels))
    metrics.update(prediction, labels, torch.full((len(prediction.margin),), 0.9))
    assert metrics.compute()["probability"]["reliability"]["expected_calibration_error"] == pytest.approx(0.1)


def test_keys_of_older_reports_keep_their_order():
    result = score(perfect_oracle(labels := articulated_labels()), labels)
    older = ["r_err_deg", "t_err", "flip_rate", "seg_miou", "legacy_r_err_deg", "legacy_t_err", "legacy_seg_miou"]
    older += ["axis_err_deg", "pivot_err", "state_err", "legacy_pivot_err"]
    older += ["chamfer_l1", "legacy_axis_err_deg", "legacy_chamfer_l1", "samples", "failures"]
    assert [name for name in result if name in older] == older


def test_batches_add_up_and_reset_forgets():
    labels = articulated_labels()
    truth = perfect_oracle(labels)
    noisy = part_turn(truth, torch.linspace(0, 180, 24), part=0)
    calibration = calibrate(truth, labels)
    whole, pieces = (ArticulatedPoseMetrics(calibration, replicates=50) for _ in range(2))
    whole.update(noisy, labels)
    for start, stop in itertools.pairwise([0, 1, 8, 24]):
        pieces.update(noisy[start:stop], part_of(labels, slice(start, stop)))
    assert_same(whole.compute(), pieces.compute())
    pieces.reset()
    with pytest.warns(UserWarning, match="before the ``update``"), pytest.raises(ValueError, match="no test cloud"):
        pieces.compute()


def assert_same(first: dict, second: dict) -> None:
    """Equal up to the order of summation."""
    assert first.keys() == second.keys()
    for key, value in first.items():
        if isinstance(value, dict):
            assert_same(value, second[key])
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            for a, b in zip(value, second[key], strict=True):
                assert_same(a, b)
        else:
            assert second[key] == pytest.approx(value, abs=1e-9), key


def noisy_world() -> tuple[Prediction, dict, ArticulatedPoseMetrics]:
    labels = articulated_labels()
    truth = perfect_oracle(labels)
    noisy = part_turn(truth, torch.linspace(0, 180, 24), part=0)
    return noisy, labels, ArticulatedPoseMetrics(calibrate(truth, labels), replicates=50)


def score_rank(rank: int, folder: str) -> None:
    torch.set_num_threads(1)  # a forked process must not wait for its parent's threads
    dist.init_process_group("gloo", init_method=f"file://{folder}/store", rank=rank, world_size=2)
    noisy, labels, metrics = noisy_world()
    mine = torch.arange(15) if rank == 0 else torch.arange(15, 24)
    for clouds in mine.split(4):
        metrics.update(noisy[clouds], part_of(labels, clouds))
    torch.save((metrics.compute(), metrics.per_object()), f"{folder}/rank{rank}.pt")
    dist.destroy_process_group()


def test_two_ranks_with_unequal_shares_equal_one_process(tmp_path):
    mp.start_processes(score_rank, args=(str(tmp_path),), nprocs=2, start_method="fork")
    noisy, labels, metrics = noisy_world()
    metrics.update(noisy, labels)
    for rank in range(2):
        gathered, per_object = torch.load(tmp_path / f"rank{rank}.pt", weights_only=True)
        assert_same(metrics.compute(), gathered)
        torch.testing.assert_close(per_object, metrics.per_object(), equal_nan=True)


def test_a_mixed_precision_prediction_is_scored():
    labels = articulated_labels(num_parts=2)
    truth = perfect_oracle(labels)
    half = replace(truth, part_shape=truth.part_shape.bfloat16(), joint_state=truth.joint_state.bfloat16())
    result = score(half, labels)
    assert result["chamfer_l1"]["mean"] < 1e-3
    assert result["r_err_deg"]["mean"] < 1e-3


def test_metrics_do_not_depend_on_the_frame_of_the_camera():
    labels = articulated_labels(num_parts=2)
    noisy = part_turn(perfect_oracle(labels), 40.0, part=1)
    shift = torch.tensor([0.0, 0.0, 2.0])
    pose = se3(torch.eye(3), shift)
    moved_labels = labels | {
        "points": labels["points"] + shift,
        "dense_points": labels["dense_points"] + shift,
        "part_pose": pose @ labels["part_pose"],
        "joint_pivot": labels["joint_pivot"] + shift,
    }
    moved = replace(noisy, part_pose=pose.double() @ noisy.part_pose, joint_pivot=noisy.joint_pivot + shift)
    train = perfect_oracle(labels)
    first, second = (score(p, l, train, labels) for p, l in ((noisy, labels), (moved, moved_labels)))
    for name in PRIMARY_ERRORS:
        assert second[name]["mean"] == pytest.approx(first[name]["mean"], abs=1e-4)
