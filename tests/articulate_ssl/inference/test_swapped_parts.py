"""Exchanged parts from near: alike for an explanation and its twin, turned with the cloud, and part of the weights."""

import pytest
import roma
import torch
from tiny import POINTS, tiny_module

from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.inference import swapped_parts
from articulate_ssl.inference.surface_decision import SurfaceDecision
from articulate_ssl.inference.swapped_parts import PartViews, exchanged_parts, log_odds_from_near, views_of_parts
from articulate_ssl.inference.two_ways import TwoWays
from articulate_ssl.network.surface_network import SurfaceSize

TINY = SurfaceSize(read=48, centers=24, dims=(8, 8), radii=(0.3, 0.5), num_neighbors=8, global_dim=16, head_dim=16)
SLOT, EXCHANGED = torch.tensor([1, 0]), (0, 0, 1)


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(swapped_parts, "_FEWEST_POINTS", 20)


@pytest.fixture
def module():
    module = tiny_module().eval()
    module.two_ways.slot.copy_(SLOT)
    module.two_ways.learnt.fill_(True)
    return module


@pytest.fixture
def clouds() -> torch.Tensor:
    """[6, 600, 3] of two plates at an angle, turned anyhow."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(6, 600, 3, generator=generator) * torch.tensor([0.6, 0.5, 0.03])
    points[:, ::2] = points[:, ::2] @ roma.rotvec_to_rotmat(torch.tensor([1.9, 0.0, 0.0])).T
    torch.manual_seed(1)
    return (points - points.mean(dim=1, keepdim=True)) @ roma.random_rotmat(6).mT


@pytest.fixture
def both(module, clouds):
    """Explanations and their twins."""
    points = clouds[:, :POINTS]
    one, _, _ = module.estimator._best(module.estimator._candidates(points, POINTS, registers=True))
    return one, module.estimator.decision.twin(one, points, registers=True)


@pytest.fixture
def network() -> SurfaceDecision:
    torch.manual_seed(0)
    return SurfaceDecision(TINY).eval()


def views(one, twin, clouds) -> PartViews:
    return views_of_parts(one, twin, SLOT, EXCHANGED, (clouds,), TINY.read)


def test_an_explanation_and_its_twin_see_the_same_in_the_opposite_order(both, clouds, network):
    one, twin = both
    here, there = views(one, twin, clouds), views(twin, one, clouds)
    assert here.known.any() and torch.equal(here.known, there.known)
    for a, b in ((here.points[0], there.points[0]), (here.surface[0], there.surface[0]), (here.frames, there.frames)):
        torch.testing.assert_close(a[here.known], b.flip(1)[here.known], atol=2e-3, rtol=0)
    odds = log_odds_from_near(network, here)
    torch.testing.assert_close(log_odds_from_near(network, there), -odds, atol=1e-3, rtol=0)
    assert odds[here.known].abs().min() > 1e-4


def test_frames_turn_with_the_cloud_and_are_right_handed(both, clouds):
    one, twin = both
    here = views(one, twin, clouds)
    turn = roma.random_rotmat(1)[0]
    moved = [some.at(se3(turn, torch.zeros(3)) @ some.base, some.state) for some in both]
    there = views(*moved, clouds @ turn.T)
    torch.testing.assert_close(there.frames, turn @ here.frames, atol=1e-4, rtol=0)
    torch.testing.assert_close(torch.linalg.det(here.frames), torch.ones(6, 2))
    # Frames that stay where they were would not do.
    assert (there.frames - here.frames).abs().amax() > 0.1


def test_the_inner_sides_face_each_other(both, clouds):
    found = views(*both, clouds)
    middle = found.points[0].mean(dim=2)
    other = middle.flip(1) - middle
    assert ((other * found.frames[..., 2]).sum(dim=-1) > 0)[found.known].all()


def test_of_parts_of_which_too_little_is_seen_nothing_is_said(both, clouds, network, monkeypatch):
    monkeypatch.setattr(swapped_parts, "_FEWEST_POINTS", 301)  # half of the points are of either plate
    found = views(*both, clouds)
    assert not found.known.any() and (log_odds_from_near(network, found) == 0).all()


def test_only_parts_of_a_joint_that_turns_can_be_exchanged():
    chain = KinematicChain(3, 0, (0, 0), (1, 2))
    assert exchanged_parts(chain, REVOLUTE, (0, 1, 2)) is None
    assert exchanged_parts(chain, REVOLUTE, (0, 2, 1)) is None  # siblings: no joint is between them
    assert exchanged_parts(chain, REVOLUTE, (2, 1, 0)) == (1, 0, 2)
    assert exchanged_parts(chain, PRISMATIC, (2, 1, 0)) is None


class Near(SurfaceDecision):
    """Says of a part how far it is from level, so strongly that nothing else counts."""

    def __init__(self, sign: float) -> None:
        super().__init__(TINY)
        self.sign = sign

    def seen(self, seen):
        return self.sign * 1e3 * seen.points[:, :, 1].std(dim=1)


@pytest.mark.parametrize("searched", [False, True])
def test_what_is_seen_from_near_decides(module, clouds, searched):
    estimator, points, found = module.estimator, clouds[:, :POINTS], {}
    module.states.limits.copy_(torch.tensor([[-1.0, 1.0]]))
    for sign in (1.0, -1.0):
        module.two_ways.near = Near(sign)
        said = estimator.search(points, clouds) if searched else estimator.predict(points, POINTS, True, clouds)
        found[sign] = said.base_pose[:, :3, :3]
    assert (roma.rotmat_geodesic_distance(found[1.0], found[-1.0]) > 0.1).any()


def test_weights_bring_the_network_and_weights_without_take_it_away(network):
    taught, other, untaught = TwoWays(2, 4), TwoWays(2, 4), TwoWays(2, 4)
    taught.near = SurfaceDecision(SurfaceSize(read=96, centers=48)).requires_grad_(False)
    taught.near.temperature.fill_(3.0)
    other.load_state_dict(taught.state_dict())
    assert other.surface is None and other.near.size.read == 96 and other.temperature == 3.0
    torch.testing.assert_close(other.near.right.weight, taught.near.right.weight, atol=0, rtol=0)
    other.load_state_dict(untaught.state_dict())
    assert other.near is None and other.temperature == 1.0
