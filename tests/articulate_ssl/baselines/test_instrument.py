"""What the comparison measures with: a perfect oracle scores zero, a constant chance, and labels that lie lose."""

import math

import pytest
from synthetic import RANGE, write_synthetic_set
from toy_methods import Constant, LookUp, States, problem

from articulate_ssl.baselines import runner
from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from datamodules.articulated_data_module import ArticulatedDataModule

POINTS = 64  # all that are stored, so that no dense point takes the part of another


def _data(root, kind=ArticulatedDataModule, **options) -> ArticulatedDataModule:
    options = {"num_points": POINTS, "batch_size": 16, "val_samples": 0, "dense_in_fit": True} | options
    return kind("laptop", root=str(root), **options)


@pytest.mark.parametrize("joint_type", [REVOLUTE, PRISMATIC])
@pytest.mark.parametrize("labelled_spaces", [True, False])
def test_a_perfect_oracle_scores_zero(tmp_path, joint_type, labelled_spaces):
    write_synthetic_set(tmp_path, points=POINTS, joint_type=joint_type)
    method, data = LookUp(problem(POINTS, joint_type)), _data(tmp_path)
    method.labelled_spaces = labelled_spaces
    method.prepare(data, seed=0)
    result = runner.test(method, data, tmp_path / "report", trained={"seconds": 0.0, "device": runner.CPU})
    for name in ("r_err_deg", "t_err", "axis_err_deg", "state_err", "chamfer_l1", "legacy_r_err_deg", "legacy_t_err"):
        assert result[name]["mean"] < 1e-4, name
    assert (result["pivot_err"]["mean"] or 0.0) < 1e-4
    assert (result["pivot_err"]["mean"] is None) == (joint_type == PRISMATIC)
    assert result["flip_rate"]["mean"] == result["above_30_rate"]["mean"] == 0.0
    assert result["seg_miou"]["mean"] == result["legacy_seg_miou"]["mean"] == 1.0


def test_a_constant_scores_chance(tmp_path):
    """Of a uniformly random rotation, P(angle <= x) = (x - sin x) / pi; the cosine of a random direction is uniform."""
    write_synthetic_set(tmp_path, points=POINTS, states=20, rotations=25)
    result = runner.test(
        Constant(problem(POINTS)), _data(tmp_path), tmp_path / "report", trained={"seconds": 0.0, "device": runner.CPU}
    )
    assert result["samples"] == 1000

    def share_above(degrees: float) -> float:
        angle = math.radians(degrees)
        return 1 - (angle - math.sin(angle)) / math.pi

    mean_angle = math.degrees(math.pi / 2 + 2 / math.pi)  # 126.5
    assert [part["mean"] for part in result["r_err_deg"]["parts"]] == pytest.approx([mean_angle] * 2, abs=4)
    assert [part["mean"] for part in result["flip_rate"]["parts"]] == pytest.approx([share_above(90)] * 2, abs=0.04)
    assert [part["mean"] for part in result["above_30_rate"]["parts"]] == pytest.approx([share_above(30)] * 2, abs=0.02)
    # The mean of arccos |u| for uniform u is one radian.
    assert result["axis_err_deg"]["mean"] == pytest.approx(math.degrees(1), abs=3)
    # The best constant is the middle of the states, from which uniform ones are a quarter of their range away.
    low, high = RANGE[REVOLUTE]
    assert result["state_err"]["mean"] == pytest.approx(math.degrees(high - low) / 4, abs=4)
    # Each part has half of the points: all of them as one part are half right for it, and wrong for the other.
    assert result["seg_miou"]["mean"] == pytest.approx(0.25, abs=0.02)


class _Shuffled(ArticulatedDataModule):
    """The same clouds; in training, each has the joint state of another."""

    def on_before_batch_transfer(self, batch, dataloader_idx):
        batch = super().on_before_batch_transfer(batch, dataloader_idx)
        return batch | {"joint_state": batch["joint_state"].roll(1, dims=0)}


def test_labels_beat_shuffled_labels(tmp_path):
    write_synthetic_set(tmp_path, points=POINTS, states=16)
    errors = []
    for kind in (ArticulatedDataModule, _Shuffled):
        data, folder = _data(tmp_path, kind), tmp_path / kind.__name__
        method = runner.seeded(States, problem(POINTS), seed=0)
        note = runner.train(method, data, folder, seed=0)
        errors.append(runner.test(method, data, folder, note)["state_err"]["mean"])
    honest, shuffled = errors
    assert honest < 13 < 15 < shuffled  # degrees; chance is 18.6
