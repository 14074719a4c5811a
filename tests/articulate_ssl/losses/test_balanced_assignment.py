"""Clouds spread over choices: evenly, and where it costs least."""

import pytest
import torch

from articulate_ssl.losses.balanced_assignment import balanced_assignment


@pytest.mark.parametrize(("clouds", "choices"), [(12, 4), (10, 4), (3, 4), (5, 1)])
def test_no_choice_is_taken_more_often_than_an_even_spread_asks(clouds, choices):
    cost = torch.rand(clouds, choices, generator=torch.Generator().manual_seed(0))
    cost[:, 0] -= 2  # every cloud would take the first
    counts = balanced_assignment(cost).bincount(minlength=choices)
    assert counts.max() <= -(-clouds // choices) and counts.sum() == clouds


def test_the_total_cost_is_least():
    """Each of four clouds prefers the first; who gains most from it gets it."""
    cost = torch.tensor([[0.0, 5.0], [0.0, 1.0], [0.0, 4.0], [0.0, 2.0]])
    assert balanced_assignment(cost).tolist() == [0, 1, 0, 1]
