"""How sure an estimate is: its margin over rivals that are turned another way."""

import roma
import torch

from articulate_ssl.geometry.se3 import se3
from articulate_ssl.inference.candidates import rivals


def _turned(degrees: list[float]) -> torch.Tensor:
    """Base poses [1, C, 4, 4] turned about one axis by so much."""
    angle = torch.tensor(degrees).deg2rad()[:, None] * torch.tensor([0.0, 0.6, 0.8])
    return se3(roma.rotvec_to_rotmat(angle), torch.zeros(len(degrees), 3))[None]


def _margins(error: torch.Tensor, base: torch.Tensor, chosen: torch.Tensor) -> torch.Tensor:
    return rivals(error, base, chosen, torch.ones_like(error, dtype=torch.bool))[1]


def test_the_margin_is_that_over_the_best_rival_turned_another_way():
    base = _turned([0.0, 10.0, 180.0, 90.0])
    error = torch.tensor([[0.03, 0.031, 0.04, 0.06]])
    torch.testing.assert_close(_margins(error, base, torch.tensor([0])), torch.tensor([0.25]))
    # The same whichever of two like hypotheses is chosen, but for their own errors.
    torch.testing.assert_close(_margins(error, base, torch.tensor([1])), torch.tensor([1 - 0.031 / 0.04]))


def test_without_a_rival_the_margin_is_one_and_with_a_better_one_zero():
    near = _turned([0.0, 20.0])
    assert _margins(torch.tensor([[0.03, 0.02]]), near, torch.tensor([0])) == 1
    apart = _turned([0.0, 120.0])
    assert _margins(torch.tensor([[0.03, 0.02]]), apart, torch.tensor([0])) == 0


def test_clouds_do_not_interact():
    base = torch.cat([_turned([0.0, 180.0]), _turned([180.0, 0.0])])
    error = torch.tensor([[0.02, 0.04], [0.04, 0.01]])
    torch.testing.assert_close(_margins(error, base, torch.tensor([0, 1])), torch.tensor([0.5, 0.75]))


def test_the_rival_is_the_best_that_is_turned_another_way_and_allowed():
    base = _turned([0.0, 10.0, 180.0, 90.0])
    error, chosen = torch.tensor([[0.03, 0.031, 0.04, 0.06]]), torch.tensor([0])
    everything = torch.ones(1, 4, dtype=torch.bool)
    assert rivals(error, base, chosen, everything)[0] == 2
    assert rivals(error, base, chosen, torch.tensor([[True, True, False, True]]))[0] == 3
    # None is left: the chosen one is its own rival.
    assert rivals(error, base, chosen, torch.tensor([[True, True, False, False]]))[0] == 0
