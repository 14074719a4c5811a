"""What confidence is learnt from: looks at a cloud, stretched or not, and whether their predictions agree."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import roma
import synthetic_predictions as synthetic
import torch

from articulate_ssl.geometry.se3 import se3
from articulate_ssl.inference.confidence import Confidence
from articulate_ssl.training.self_agreement import agree, another_look, learn_confidence, look_again, stretches


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


def test_stretches_go_along_the_axes_of_the_base_and_leave_the_size():
    prediction, points = synthetic.laptop()
    many = torch.zeros(50, dtype=torch.int64)
    prediction, points = prediction[many], points[None].expand(50, -1, 3)
    stretch = stretches(prediction, points, torch.Generator().manual_seed(0))
    torch.testing.assert_close(stretch, stretch.mT)
    torch.testing.assert_close((points @ stretch).norm(dim=-1).mean(dim=1), points.norm(dim=-1).mean(dim=1))
    base = points[0][prediction.part_id[0] == 0]
    covariance = torch.cov(base.T)
    torch.testing.assert_close(stretch @ covariance, covariance @ stretch, atol=1e-5, rtol=0)
    least, *_, most = torch.linalg.eigvalsh(stretch).unbind(dim=1)
    assert 3 < (most / least).max() <= 4.001 and (most / least).min() < 1.5


def _frame(points: torch.Tensor) -> torch.Tensor:  # [B, N, 3] -> [B, 3, 3]
    """Principal axes, the shortest first, towards where fewer points are."""
    axes = torch.linalg.eigh(points.mT @ points).eigenvectors
    axes = axes * ((points @ axes) ** 3).sum(dim=1, keepdim=True).sign()
    return torch.stack([axes[..., 0], axes[..., 1], torch.linalg.cross(axes[..., 0], axes[..., 1])], dim=-1)


class _KnowsBlocks:
    """Takes the longest direction of a block for its width, as it is in all blocks it knows; halves are its parts."""

    num_points, inference, orientation = 200, SimpleNamespace(points=200), SimpleNamespace(limited=False)
    size = torch.tensor([0.1, 0.15, 0.22])  # standard deviations

    def __init__(self) -> None:
        self.confidence = Confidence()

    def predict_points(self, points: torch.Tensor, dense: torch.Tensor):
        frame = _frame(points)
        own = points @ frame
        found = synthetic.laptop()[0][torch.zeros(len(points), dtype=torch.int64)]
        pose = se3(frame, torch.zeros(len(points), 3))
        error = 0.01 + 0.01 * (own.std(dim=1) / self.size).log().abs().sum(dim=1)
        return replace(found, base_pose=pose, part_id=(own[..., 2] > 0).long(), reconstruction_error=error)

    def blocks(self, count: int) -> torch.Tensor:
        generator = torch.Generator().manual_seed(0)
        points = torch.rand(count, 400, 3, generator=generator) ** 2 - 1 / 3
        turn = roma.unitquat_to_rotmat(torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=1))
        return points / points.std(dim=(0, 1)) * self.size @ turn.mT


def test_stretched_clouds_tell_that_what_is_unlike_is_not_known():
    module = _KnowsBlocks()
    clouds = module.blocks(96)
    plain, stretched = look_again(module, clouds)
    assert plain.agrees.float().mean() > 0.95
    assert stretched.error.median() > plain.error.median()
    assert 0.3 < stretched.agrees.float().mean() < 0.95
    learn_confidence(module, clouds)
    assert module.confidence.strangeness < -0.05
    low, high = module.confidence.probability(torch.full((2,), 0.4), torch.tensor([plain.error.median(), 1.0]))
    assert high < low - 0.3
