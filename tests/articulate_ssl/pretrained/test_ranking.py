"""Explanations by weights of different categories are compared by what is usual for each."""

from dataclasses import replace

import pytest
import synthetic_predictions as synthetic
import torch
from scan_predictions import result_of

from articulate_ssl.inference.scan_prediction import ScanPrediction
from articulate_ssl.pretrained.ranking import how_sure, ranked


def explanation(category: str, error: float, unlike: float | None) -> ScanPrediction:
    """One of the same scan."""
    result = result_of(synthetic.laptop)
    moved = replace(result.prediction, reconstruction_error=torch.tensor([error], dtype=torch.float64))
    return replace(result, prediction=moved, category=category, unlike=unlike)


def order(*explanations: ScanPrediction) -> list[str]:
    return [explanation.category for explanation in ranked(explanations)]


def test_what_is_usual_for_its_category_beats_a_smaller_error():
    assert order(explanation("laptop", 0.01, 0.9), explanation("oven", 0.03, 0.4)) == ["oven", "laptop"]


def test_beyond_all_training_clouds_the_error_decides():
    found = order(explanation("laptop", 0.05, 1.0), explanation("oven", 0.03, 1.0), explanation("safe", 0.09, 0.99))
    assert found == ["safe", "oven", "laptop"]


def test_where_one_has_not_learnt_what_is_usual_the_error_decides_for_all():
    assert order(explanation("laptop", 0.03, None), explanation("oven", 0.04, 0.1)) == ["laptop", "oven"]


def test_the_error_is_relative_to_the_size_of_the_scan():
    small, large = (result_of(synthetic.laptop, scale=scale) for scale in (0.4, 400.0))
    assert large.relative_error == pytest.approx(small.relative_error)
    assert explanation("laptop", 0.02, None).relative_error == pytest.approx(
        2 * explanation("laptop", 0.01, None).relative_error
    )


def test_it_is_sure_if_only_one_category_explains_the_scan_as_its_own():
    laptop = explanation("laptop", 0.01, 0.5)
    assert how_sure([laptop, explanation("laptop", 0.01, 0.6), explanation("oven", 0.1, 1.0)]).startswith("sure: only")
    assert "oven would explain" in how_sure([laptop, explanation("oven", 0.02, 0.7)])
    strange = how_sure([explanation("laptop", 0.1, 0.97), explanation("oven", 0.2, 1.0)])
    assert strange.startswith("unsure") and "97%" in strange
    assert "error alone" in how_sure([laptop, explanation("oven", 0.02, None)])
