"""What confidence is learnt from: two looks at a cloud and whether their predictions agree."""

from dataclasses import replace

import pytest
import roma
import synthetic_predictions as synthetic
import torch

from articulate_ssl.geometry.se3 import se3
from articulate_ssl.training.self_agreement import agree, another_look


def _seen_again(degrees: float, turn: torch.Tensor) -> tuple:
    """A prediction, the same of the turned cloud but for an error of so many degrees, and both clouds."""
    first, points = synthetic.laptop()
    wrong = roma.rotvec_to_rotmat(torch.tensor([0.0, 0.6, 0.8]) * torch.tensor(degrees).deg2rad())
    base = se3((turn @ wrong).to(first.base_pose), torch.zeros(3).to(first.base_pose)) @ first.base_pose
    return first, replace(first, base_pose=base), (points[None], points[None] @ turn.mT), turn[None]


@pytest.mark.parametrize(("degrees", "expected"), [(0.0, True), (20.0, True), (45.0, False), (180.0, False)])
def test_orientations_agree_when_the_turn_is_undone(degrees, expected):
    turn = roma.random_rotmat(1)[0]
    assert bool(agree(*_seen_again(degrees, turn))) == expected


def test_exchanged_parts_do_not_agree():
    first, second, points, turn = _seen_again(0.0, torch.eye(3))
    assert not agree(first, replace(second, part_id=1 - second.part_id), points, turn)


@pytest.mark.parametrize("limited", [True, False])
def test_another_look_is_part_of_the_cloud_turned(limited):
    clouds = torch.randn(3, 100, 3, generator=torch.Generator().manual_seed(0))
    again, turn = another_look(clouds, limited, torch.Generator().manual_seed(1))
    assert again.shape == (3, 60, 3)
    assert torch.cdist((again @ turn).double(), clouds.double()).amin(dim=-1).max() < 1e-5
    angle = roma.rotmat_geodesic_distance_naive(turn, torch.eye(3).expand(3, 3, 3)).rad2deg()
    assert (angle.max() <= 20.1) if limited else (angle.max() > 60)
    same, _ = another_look(clouds, limited, torch.Generator().manual_seed(1))
    assert torch.equal(again, same)
