"""From relief that is sure of some clouds to a network that knows the others."""

import pytest
import roma
import torch

from articulate_ssl.network.surface_network import SurfaceSize
from articulate_ssl.training import surface_lessons
from articulate_ssl.training.surface_lessons import Lessons, learn_surface, teach

TINY = SurfaceSize(read=48, centers=32, dims=(8, 8), radii=(0.3, 0.5), num_neighbors=8, global_dim=16, head_dim=16)


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(surface_lessons, "SIZE", TINY)
    monkeypatch.setattr(surface_lessons, "FEWEST", 20)


def wedges(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Clouds [n, 300, 3] that are thick at one end, turned anyhow; and frames [n, 2, 3, 3], the right one first."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 300, 3, generator=generator) - 0.5
    points = points * torch.tensor([0.8, 0.5, 0.4])
    points[..., 2] *= 0.2 + (points[..., 0] + 0.4)
    quaternion = torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=1)
    right = roma.unitquat_to_rotmat(quaternion)
    wrong = right @ torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
    return points @ right.mT, torch.stack([right, wrong], dim=1)


def test_the_network_decides_clouds_that_it_never_saw():
    clouds, frames = wedges(120, 0)
    noise = 0.002 * torch.randn(clouds.shape, generator=torch.Generator().manual_seed(1))
    decision = learn_surface([clouds, clouds + noise], frames, torch.arange(120), 0.6)
    clouds, frames = wedges(60, 7)
    assert (decision.log_odds(frames, clouds) > 0).double().mean() > 0.9


def test_of_several_frames_it_finds_the_right_one():
    clouds, frames = wedges(160, 0)
    quarter = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    several = torch.cat([frames, frames @ quarter], dim=1)  # of four ways, the first is right
    decision = learn_surface([clouds], several, torch.arange(160), 0.6)
    clouds, frames = wedges(60, 7)
    several = torch.cat([frames, frames @ quarter], dim=1).flip(1)
    assert (decision.looks_right(several, clouds).argmax(dim=1) == 3).double().mean() > 0.8


def test_it_knows_more_than_a_teacher_that_is_sometimes_wrong():
    clouds, frames = wedges(200, 0)
    wrong = torch.rand(200, generator=torch.Generator().manual_seed(1)) < 0.1
    taught = torch.where(wrong[:, None, None, None], frames.flip(1), frames)
    decision = learn_surface([clouds], taught, torch.arange(200), 0.6)
    assert (decision.log_odds(frames, clouds) > 0).double().mean() > 0.95 > (~wrong).double().mean()


def test_odds_are_believed_as_far_as_the_teacher_confirms_them():
    """The more of the clouds that do not teach the teacher says something else of, the less."""
    clouds, frames = wedges(120, 0)
    contested = frames.clone()
    contested[96:104] = frames[96:104].flip(1)
    sure, doubtful = (learn_surface([clouds], some, torch.arange(120), 0.5) for some in (frames, contested))
    assert doubtful.temperature > 2 * sure.temperature
    odds = sure.log_odds(frames, clouds)
    torch.testing.assert_close(doubtful.log_odds(frames, clouds), odds, atol=0, rtol=0)


def test_what_contradicts_its_teacher_is_thrown_away(caplog):
    """Of the clouds that do not teach, it says the opposite of what the teacher says."""
    clouds, frames = wedges(120, 0)
    frames[96:] = frames[96:].flip(1)
    assert learn_surface([clouds], frames, torch.arange(120), 0.6) is None
    assert "too few" in caplog.text


def test_few_clouds_teach_nothing(monkeypatch):
    clouds, frames = wedges(30, 0)
    monkeypatch.setattr(surface_lessons, "teach", lambda _: pytest.fail("taught in vain"))
    assert learn_surface([clouds], frames, torch.arange(24), 0.6) is None  # of which 19 would teach


def test_lessons_are_the_same_every_time_and_leave_the_random_state_alone(monkeypatch):
    monkeypatch.setattr(surface_lessons, "TIMES", 4)
    lessons = Lessons.of([wedges(20, 0)[0]], wedges(20, 0)[1])
    torch.manual_seed(5)
    first = teach(lessons)
    drawn = torch.rand(1)
    torch.manual_seed(5)
    assert torch.equal(torch.rand(1), drawn)
    second = teach(lessons)
    for one, other in zip(first.state_dict().values(), second.state_dict().values(), strict=True):
        torch.testing.assert_close(one, other, atol=0, rtol=0)
    assert not any(parameter.requires_grad for parameter in first.parameters())


@pytest.mark.parametrize("mirrored", [False, True])
def test_looks_are_in_the_mirror_half_of_the_times(mirrored):
    """Points and their normals alike; of what is not to be mirrored, nothing is."""
    clouds, frames = wedges(200, 0)
    cloud, own = Lessons.of([clouds], frames).draw(200, TINY, torch.Generator().manual_seed(0))
    seen = cloud.seen_in(own)
    varied = surface_lessons._varied(seen, mirrored, torch.Generator().manual_seed(0))
    sign = (varied.points * seen.points).sum(dim=1).sign()
    assert (sign[:, [0, 2]] == 1).all()
    assert (sign[:, 1] < 0).double().mean() == pytest.approx(0.5 if mirrored else 0, abs=0.1)
    flipped = (varied.normal[..., 1] * seen.normal[..., 1]).sum(dim=1) < 0
    assert torch.equal(flipped, sign[:, 1] < 0)


def test_what_is_doubted_contradicts_no_more_than_that_is_improbable():
    odds = torch.tensor([-100.0, -3.0, 0.0, 3.0, 100.0], dtype=torch.float64, requires_grad=True)
    believed = surface_lessons._believed(odds, 0.1)
    expected = (0.9 * odds.sigmoid() + 0.1 * (-odds).sigmoid()).log()
    torch.testing.assert_close(believed, expected)
    believed.sum().backward()
    assert odds.grad[0].abs() < 1e-6 and odds.grad[1] > 0.1
    torch.testing.assert_close(surface_lessons._believed(odds, 0.0), odds.sigmoid().log(), atol=1e-5, rtol=1e-5)


def test_drawn_clouds_are_those_of_their_frames():
    """Whatever the version and the points drawn, in the right frame the thick end is where it is."""
    clouds, frames = wedges(20, 0)
    lessons = Lessons.of([clouds, clouds + 1e-3], frames)
    cloud, own = lessons.draw(20, TINY, torch.Generator().manual_seed(0))
    assert cloud.points.shape == (20, TINY.read, 3)
    seen = cloud.seen_in(own[:, :1]).points
    thick, thin = (seen[..., 2].abs() * (sign * seen[..., 0] > 0.1) for sign in (1, -1))
    assert (thick.amax(dim=1) > thin.amax(dim=1)).double().mean() > 0.9
