"""From pairs of parts of which relief says which is which to a network that tells others apart."""

import pytest
import roma
import torch

from articulate_ssl.inference.surface_decision import LOOKS, surface_alone
from articulate_ssl.inference.swapped_parts import PartViews, log_odds_from_near
from articulate_ssl.network.surface_network import SurfaceSize
from articulate_ssl.training import near_lessons
from articulate_ssl.training.near_lessons import PartLessons, learn_from_near

TINY = SurfaceSize(read=48, centers=32, dims=(8, 8), radii=(0.3, 0.5), num_neighbors=8, global_dim=16, head_dim=16)


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(near_lessons, "SIZE", TINY)
    monkeypatch.setattr(near_lessons, "FEWEST", 20)


def pairs(count: int, seed: int) -> tuple[PartViews, torch.Tensor]:
    """Of pairs of plates, in either order, one is thick at its far end; and whether that is the first one."""
    generator = torch.Generator().manual_seed(seed)
    plates = (torch.rand(count, 2, 300, 3, generator=generator) - 0.5) * torch.tensor([0.8, 0.5, 0.3])
    plates[:, 0, :, 2] *= 0.2 + 2 * (plates[:, 0, :, 1] + 0.25)
    plates[:, 1, :, 2] *= 0.6
    right = torch.rand(count, generator=generator) < 0.5
    plates = torch.where(right[:, None, None, None], plates, plates.flip(1))
    quaternion = torch.nn.functional.normalize(torch.randn(count, 2, 4, generator=generator), dim=-1)
    frames = roma.unitquat_to_rotmat(quaternion)
    clouds, own = (plates @ frames.mT).flatten(0, 1), torch.ones(2 * count, 300, dtype=torch.bool)
    points, surface = (x.unflatten(0, (-1, 2))[None] for x in surface_alone(clouds, own, LOOKS * TINY.read))
    return PartViews(points, surface, frames, torch.ones(count, dtype=torch.bool)), right


def share_right(decision, views: PartViews, right: torch.Tensor) -> float:
    return float(((log_odds_from_near(decision, views) > 0) == right).double().mean())


def test_the_network_tells_parts_apart_that_it_never_saw():
    views, right = pairs(160, 0)
    decision = learn_from_near(views, right, torch.zeros(160), torch.arange(160), 0.6)
    assert share_right(decision, *pairs(60, 7)) > 0.9


def test_it_is_believed_with_the_network_that_sees_whole_clouds():
    """One that contradicts the teacher makes the sum of both less sure."""
    views, right = pairs(160, 0)
    side = 2.0 * right - 1
    alone, contradicted = (
        learn_from_near(views, right, whole, torch.arange(160), 0.6) for whole in (torch.zeros(160), -8 * side)
    )
    assert contradicted.temperature > 2 * alone.temperature


def test_what_contradicts_its_teacher_is_thrown_away(caplog):
    views, right = pairs(160, 0)
    right[128:] = ~right[128:]
    assert learn_from_near(views, right, torch.zeros(160), torch.arange(160), 0.6) is None
    assert "too few" in caplog.text


def test_few_clouds_and_clouds_of_which_little_is_seen_teach_nothing(monkeypatch):
    monkeypatch.setattr(near_lessons, "teach", lambda *_: pytest.fail("taught in vain"))
    views, right = pairs(30, 0)
    assert learn_from_near(views, right, torch.zeros(30), torch.arange(24), 0.6) is None  # of which 19 would teach
    views.known[:10] = False
    assert learn_from_near(views, right, torch.zeros(30), torch.arange(30), 0.6) is None


def test_drawn_parts_come_in_pairs_the_right_one_first():
    """Seen in its frame, the first one is thick at its far end, and no second one is."""
    views, right = pairs(20, 0)
    cloud, frames = PartLessons.of_views(views, right).draw(20, TINY, torch.Generator().manual_seed(0))
    assert frames.shape == (40, 1, 3, 3)
    seen = cloud.seen_in(frames).points.view(20, 2, TINY.read, 3)
    far, close = (seen[..., 2].abs() * (sign * seen[..., 1] > 0.05) for sign in (1, -1))
    thicker = far.amax(dim=2) / close.amax(dim=2)
    assert (thicker[:, 0] > thicker[:, 1]).double().mean() > 0.9
