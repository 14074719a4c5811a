"""Figures without labels: nothing for predictions that stay what they are, and each change where it belongs."""

from __future__ import annotations

from dataclasses import replace

import pytest
import roma
import torch
from articulated_world import articulated_labels

from articulate_ssl.baselines.perfect_oracle import perfect_oracle
from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.metrics.label_free import LabelFreeMetrics, label_free_figures

CLOUDS = 6


def rotations(count: int) -> torch.Tensor:  # [count, 3, 3]
    quaternion = torch.randn(count, 4, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    return roma.unitquat_to_rotmat(torch.nn.functional.normalize(quaternion, dim=1))


def turned(prediction: Prediction, turn: torch.Tensor) -> Prediction:
    """What an equivariant method says about the turned cloud."""
    turn = turn.to(prediction.base_pose)
    pose = se3(turn, turn.new_zeros(len(turn), 3))
    return replace(
        prediction,
        base_pose=pose @ prediction.base_pose,
        part_pose=pose[:, None] @ prediction.part_pose,
        joint_axis=(turn[:, None] @ prediction.joint_axis[..., None]).squeeze(-1),
    )


@pytest.fixture(params=[REVOLUTE, PRISMATIC])
def case(request):
    labels = articulated_labels(CLOUDS, num_parts=3, joint_types=(request.param,) * 2)
    prediction = perfect_oracle(labels)
    turn = rotations(CLOUDS)
    again = labels["points"].flip(1).double()  # other points come in another order
    second = replace(turned(prediction, turn), part_id=prediction.part_id.flip(1))
    return prediction, second, (labels["points"], (again @ turn.mT).float()), turn


def test_a_prediction_that_stays_has_nothing_to_report(case):
    figures = label_free_figures(*case)
    for name in ("repeat_r_deg", "repeat_above_30_rate", "repeat_axis_deg", "repeat_state"):
        torch.testing.assert_close(figures[name], torch.zeros_like(figures[name]), atol=1e-5, rtol=0)
    assert (figures["repeat_miou"] == 1).all()
    torch.testing.assert_close(figures["part_share"].sum(dim=1), torch.ones(CLOUDS, dtype=torch.float64))


def test_every_change_shows_in_its_own_figure(case):
    first, second, points, turn = case
    still = label_free_figures(*case)

    def changed(**fields) -> set[str]:
        figures = label_free_figures(first, replace(second, **fields), points, turn)
        return {name for name in figures if not torch.allclose(figures[name], still[name], atol=1e-5)}

    quarter = se3(roma.rotvec_to_rotmat(torch.tensor([0.0, 0.0, torch.pi / 2])), torch.zeros(3))
    assert changed(base_pose=second.base_pose @ quarter) == {"repeat_r_deg", "repeat_above_30_rate"}
    assert changed(joint_state=second.joint_state + 0.1) == {"repeat_state"}
    assert changed(joint_axis=second.joint_axis.roll(1, dims=-1)) == {"repeat_axis_deg"}
    assert changed(part_id=(second.part_id + 1) % 3) == {"repeat_miou"}


def test_states_are_degrees_of_hinges_and_lengths_of_slides(case):
    first, second, points, turn = case
    figures = label_free_figures(first, replace(second, joint_state=second.joint_state + 0.1), points, turn)
    expected = torch.tensor(0.1, dtype=torch.float64)
    expected = expected.rad2deg() if first.joint_type[0, 0] == REVOLUTE else expected
    torch.testing.assert_close(figures["repeat_state"], expected.expand(CLOUDS, 2), rtol=1e-5, atol=0)


def test_flat_errors_are_relative_to_the_size_of_the_cloud(case):
    first, second, points, turn = case
    figures = label_free_figures(replace(first, reconstruction_error=torch.full((CLOUDS,), 0.02)), second, points, turn)
    size = points[0].norm(dim=-1).mean(dim=-1).double()
    torch.testing.assert_close(figures["relative_error"], 0.02 / size, rtol=1e-5, atol=0)


def test_every_cloud_counts_and_the_smallest_part_is_named(case):
    first, second, points, turn = case
    metrics = LabelFreeMetrics(replicates=50)
    first = replace(first, part_id=torch.zeros_like(first.part_id))
    half = slice(None, CLOUDS // 2), slice(CLOUDS // 2, None)
    for rows in half:
        some = points[0][rows], points[1][rows]
        metrics.update(first[rows], second[rows], some, turn[rows], torch.tensor([0, 1, 1]))
    result = metrics.compute()
    assert (result["samples"], result["failures"], result["instances"]) == (CLOUDS, 0, 2)
    assert result["part_share"]["mean"] == 0 and result["part_share"]["parts"][0]["mean"] == 1
    assert len(result["repeat_axis_deg"]["joints"]) == 2 and result["repeat_r_deg"]["ci95"] is not None
    assert "probability" not in result


def test_a_probability_is_reported_where_there_is_one(case):
    metrics = LabelFreeMetrics(replicates=50)
    metrics.update(*case, torch.zeros(CLOUDS), probability=torch.linspace(0, 1, CLOUDS))
    assert metrics.compute()["probability"]["mean"] == pytest.approx(0.5)


def test_an_empty_test_set_is_refused():
    with pytest.raises(ValueError, match="no test cloud"):
        LabelFreeMetrics().compute()
