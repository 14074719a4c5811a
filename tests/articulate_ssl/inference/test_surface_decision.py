"""A decision by the surface: turned with the cloud, antisymmetric, blind to the batch, and part of the weights."""

import pytest
import roma
import torch
from tiny import tiny_module

from articulate_ssl.inference.surface_decision import SurfaceDecision
from articulate_ssl.inference.two_ways import TwoWays
from articulate_ssl.network.surface_network import SurfaceSize

TINY = SurfaceSize(read=48, centers=32, dims=(8, 8), radii=(0.3, 0.5), num_neighbors=8, global_dim=16, head_dim=16)


@pytest.fixture
def clouds() -> torch.Tensor:
    """[3, 400, 3] of bent plates, in farthest-point order as far as a random one is."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(3, 400, 3, generator=generator) * torch.tensor([0.6, 0.5, 0.03])
    points[:, ::2] = points[:, ::2] @ roma.rotvec_to_rotmat(torch.tensor([1.2, 0.0, 0.0])).T
    return points - points.mean(dim=1, keepdim=True)


@pytest.fixture
def frames() -> torch.Tensor:
    """[3, 2, 3, 3]."""
    torch.manual_seed(1)
    return roma.random_rotmat(6).view(3, 2, 3, 3)


def decision(dtype=torch.float32) -> SurfaceDecision:
    torch.manual_seed(0)
    return SurfaceDecision(TINY).eval().to(dtype)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-3), (torch.float64, 1e-9)])
def test_a_cloud_that_is_turned_with_its_frames_is_decided_alike(clouds, frames, dtype, tolerance):
    clouds, frames, judge = clouds.to(dtype), frames.to(dtype), decision(dtype)
    turn = roma.random_rotmat(3, dtype=dtype)
    odds = judge.log_odds(frames, clouds)
    turned = judge.log_odds(turn[:, None] @ frames, clouds @ turn.mT + 0.3)
    torch.testing.assert_close(turned, odds, atol=tolerance, rtol=0)
    # What sees the cloud as it comes would fail this.
    ignorant = judge.log_odds(frames, clouds @ turn.mT)
    assert (ignorant - odds).abs().max() > 10 * tolerance


def test_frames_that_are_exchanged_turn_the_odds_round(clouds, frames):
    odds = decision().log_odds(frames, clouds)
    torch.testing.assert_close(decision().log_odds(frames.flip(1), clouds), -odds, atol=1e-5, rtol=0)
    assert odds.abs().min() > 1e-4


def test_the_batch_does_not_matter(clouds, frames):
    judge = decision()
    alone = torch.cat([judge.log_odds(frames[i : i + 1], clouds[i : i + 1]) for i in range(3)])
    torch.testing.assert_close(judge.log_odds(frames, clouds), alone, atol=1e-5, rtol=0)


def test_clouds_with_fewer_points_than_are_read_are_decided_too(clouds, frames):
    assert decision().log_odds(frames, clouds[:, :40]).isfinite().all()


def test_weights_bring_the_network_and_weights_without_take_it_away():
    taught, other, untaught = TwoWays(2, 4), TwoWays(2, 4), TwoWays(2, 4)
    torch.manual_seed(0)
    taught.surface = SurfaceDecision().requires_grad_(False)
    other.load_state_dict(taught.state_dict())
    torch.testing.assert_close(other.surface.right.weight, taught.surface.right.weight, atol=0, rtol=0)
    assert not any(parameter.requires_grad for parameter in other.parameters())
    other.load_state_dict(untaught.state_dict())
    assert other.surface is None


def test_weights_say_how_many_points_were_read_and_older_ones_read_256():
    taught, other = TwoWays(2, 4), TwoWays(2, 4)
    taught.surface = SurfaceDecision(SurfaceSize(read=96, centers=48)).requires_grad_(False)
    other.load_state_dict(taught.state_dict())
    assert (other.surface.size.read, other.surface.size.centers) == (96, 48)
    older = {name: value for name, value in taught.state_dict().items() if name != "surface.read"}
    other.load_state_dict(older)
    assert (other.surface.size.read, other.surface.size.centers) == (256, 128)


def test_what_is_learnt_after_the_last_step_is_not_optimised():
    """A run that ended and goes on has the optimiser of its beginning."""
    module = tiny_module()
    before = [len(group["params"]) for group in module.configure_optimizers()["optimizer"].param_groups]
    module.two_ways.surface = SurfaceDecision().requires_grad_(False)
    after = [len(group["params"]) for group in module.configure_optimizers()["optimizer"].param_groups]
    assert after == before
