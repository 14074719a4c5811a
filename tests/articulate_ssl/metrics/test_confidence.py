import json
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torchmetrics.functional.classification import binary_auroc, binary_calibration_error

from articulate_ssl.metrics.confidence import auroc, confident_half, reliability_table, report_confidence


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 8), st.booleans()), min_size=2, max_size=40))
def test_auroc_equals_torchmetrics_and_counting_pairs(pairs):
    score = torch.tensor([s / 8 for s, _ in pairs])
    positive = torch.tensor([p for _, p in pairs])
    if positive.all() or not positive.any():
        assert math.isnan(auroc(score, positive))
        return
    won = [float(a > b) + 0.5 * float(a == b) for a in score[positive] for b in score[~positive]]
    assert auroc(score, positive) == pytest.approx(sum(won) / len(won))
    assert auroc(score, positive) == pytest.approx(binary_auroc(score, positive.long()).item(), abs=1e-6)


def test_auroc_ranks_large_scores_apart():
    score, positive = torch.tensor([100.0, 200.0, 300.0, 400.0]), torch.tensor([False, False, True, True])
    assert auroc(score, positive) == 1.0
    assert auroc(-score, positive) == 0.0
    assert auroc(torch.ones(4), positive) == 0.5


def test_reliability_of_known_bins():
    confidence = torch.tensor([0.0, 0.1, 0.25, 0.5, 0.6, 1.0])
    correct = torch.tensor([False, True, True, False, True, True])
    table = reliability_table(confidence, correct, bins=4)
    assert table["edges"] == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert table["count"] == [2, 1, 2, 1]
    assert table["mean_confidence"] == pytest.approx([0.05, 0.25, 0.55, 1.0])
    assert table["share_correct"] == pytest.approx([0.5, 1.0, 0.5, 1.0])
    expected = (2 * 0.45 + 1 * 0.75 + 2 * 0.05 + 0) / 6
    assert table["expected_calibration_error"] == pytest.approx(expected)


@pytest.mark.parametrize("bins", [1, 7, 10])
def test_calibration_error_equals_torchmetrics_below_one(bins):
    generator = torch.Generator().manual_seed(0)
    confidence, correct = torch.rand(500, generator=generator), torch.rand(500, generator=generator) < 0.4
    table = reliability_table(confidence, correct, bins)
    expected = binary_calibration_error(confidence, correct.long(), bins).item()
    assert table["expected_calibration_error"] == pytest.approx(expected, abs=1e-6)


def test_certainty_shares_the_last_bin():
    table = reliability_table(torch.tensor([0.8, 1.0]), torch.tensor([True, False]), bins=2)
    assert table["count"] == [0, 2]
    assert table["expected_calibration_error"] == pytest.approx(0.4)


def test_reliability_tells_calibrated_from_overconfident():
    generator = torch.Generator().manual_seed(0)
    confidence = torch.rand(20000, generator=generator)
    correct = torch.rand(20000, generator=generator) < confidence
    assert reliability_table(confidence, correct)["expected_calibration_error"] < 0.02
    assert reliability_table(confidence.sqrt(), correct)["expected_calibration_error"] > 0.1


def test_an_empty_bin_is_null():
    table = reliability_table(torch.tensor([0.9]), torch.tensor([True]), bins=2)
    assert table["mean_confidence"] == [None, pytest.approx(0.9)]
    assert table["share_correct"] == [None, 1.0]


@pytest.mark.parametrize("bad", [1.1, -0.1, math.nan])
def test_what_is_no_share_is_refused(bad):
    with pytest.raises(ValueError, match="confidence"):
        reliability_table(torch.tensor([0.5, bad]), torch.tensor([True, True]))


def test_the_confident_half():
    error = torch.tensor([[170.0, 10.0], [2.0, 4.0], [6.0, 8.0], [100.0, 100.0], [1.0, 1.0]])
    half = confident_half(error, torch.tensor([0.9, 0.8, 0.1, 0.2, 0.7]))
    assert half == {
        "samples": 3,
        "mean": pytest.approx((90 + 3 + 1) / 3),
        "median": pytest.approx(3.0),
        "flips": 1,
        "share_of_all_flips": 0.5,
    }
    assert confident_half(error, -error.amax(1))["share_of_all_flips"] == 0.0
    assert confident_half(error[1:3], torch.rand(2))["share_of_all_flips"] is None


def test_a_confidence_that_knows_nothing_scores_chance_and_one_that_knows_all_does_not():
    generator = torch.Generator().manual_seed(0)
    error = torch.where(torch.rand(4000, generator=generator) < 0.3, 170.0, 5.0)
    ignorant = report_confidence(torch.rand(4000, generator=generator), error)
    assert ignorant["auroc_not_flipped"] == pytest.approx(0.5, abs=0.03)
    assert ignorant["confident_half"]["share_of_all_flips"] == pytest.approx(0.5, abs=0.05)
    knowing = report_confidence(1 - error / 180, error)
    assert knowing["auroc_correct"] == knowing["auroc_not_flipped"] == 1.0
    assert knowing["confident_half"]["flips"] == 0


def test_the_report_is_plain_numbers():
    error = torch.tensor([[10.0, 20.0], [10.0, 40.0], [100.0, 3.0], [1.0, 1.0]])
    report = report_confidence(torch.tensor([0.9, 0.5, 0.1, 0.8]), error)
    assert json.loads(json.dumps(report, allow_nan=False)) == report
    assert sum(report["reliability"]["count"]) == 4
    assert report["reliability"]["share_correct"][5] == 0.0  # 40 degrees is not correct, but no flip
    assert report["auroc_correct"] == report["auroc_not_flipped"] == 1.0


def test_a_score_that_is_no_share_has_no_reliability_and_equal_clouds_no_auroc():
    report = report_confidence(torch.tensor([-3.0, 7.0]), torch.tensor([5.0, 6.0]))
    assert report["reliability"] is None
    assert report["auroc_correct"] is report["auroc_not_flipped"] is None
    assert report["confident_half"]["mean"] == 6.0
    with pytest.raises(ValueError, match="NaN"):
        report_confidence(torch.tensor([math.nan, 1.0]), torch.zeros(2))
    with pytest.raises(ValueError, match="2 clouds"):
        report_confidence(torch.ones(3), torch.zeros(2))
