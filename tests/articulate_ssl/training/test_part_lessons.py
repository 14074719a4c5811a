"""A network learns which part points are of, from clouds whose points have parts."""

import torch

from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.geometry.screw import PRISMATIC
from articulate_ssl.shape.joints import Joints
from articulate_ssl.training import part_lessons
from articulate_ssl.training.part_lessons import PartLessons, teach_parts

OUT = torch.tensor([0.0, 0.0, 1.0])
JOINTS = Joints(KinematicChain(3, 0, (0, 0), (1, 2)), OUT.expand(2, 3), torch.zeros(2, 3), PRISMATIC)


def _chests(count: int, seed: int, points: int = 600) -> tuple[torch.Tensor, torch.Tensor]:
    """Plates: a body behind, and two in front of it, one above the other, their edge at any height."""
    generator = torch.Generator().manual_seed(seed)
    part = torch.arange(points) % 3
    edge = 0.3 * torch.rand(count, 1, generator=generator) - 0.15
    height = torch.rand(count, points, generator=generator)
    low = torch.where(part == 1, edge, -0.5)
    high = torch.where(part == 2, edge, torch.tensor(0.5))
    y = low + height * (high - low)
    depth = torch.where(part == 0, 0.0, 0.2 + 0.3 * torch.rand(count, 2, generator=generator)[:, part.clamp(min=1) - 1])
    return torch.stack([torch.rand(count, points, generator=generator) - 0.5, y, depth], dim=-1), part.expand(count, -1)


def test_unseen_objects_have_their_parts(monkeypatch):
    monkeypatch.setattr(part_lessons, "_STEPS", 60)
    network = teach_parts(*_chests(24, seed=0), JOINTS)
    clouds, part = _chests(6, seed=1)
    said = network.probability(clouds, torch.eye(3).expand(6, 1, 3, 3))[:, 0].argmax(dim=-1)
    assert (said == part).float().mean() > 0.9
    # Points that lie upside down are of the other parts.
    over = torch.diag(torch.tensor([-1.0, -1.0, 1.0])).expand(6, 1, 3, 3)
    turned = network.probability(clouds, over)[:, 0].argmax(dim=-1)
    assert (turned == part).float().mean() < 0.6


def test_lessons_are_even_shares_whose_labels_are_known():
    clouds, part = _chests(3, seed=2, points=4096)
    lessons = PartLessons.of(clouds, part[:, :2000], 900)
    assert lessons.boxes.shape == (6, 900, 3) and lessons.part.shape == (6, 900)
    assert torch.equal(lessons.part[0], part[0, 0:1800:2]) and torch.equal(lessons.part[3], part[0, 1:1800:2])
    assert lessons.boxes.abs().amax() < 0.55


def test_what_is_shown_varies_and_some_parts_stay():
    lessons = PartLessons.of(*_chests(3, seed=3), 400)
    generator = torch.Generator().manual_seed(0)
    one, other = (lessons.draw(JOINTS, 300, generator) for _ in range(2))
    assert one.boxes.shape == (16, 300, 3) and one.part.shape == (16, 300) and one.images.dtype == torch.float32
    assert not torch.equal(one.boxes, other.boxes)
    behind = [len(cloud[own == 0, 2].unique()) for cloud, own in zip(one.boxes, one.part, strict=True)]
    assert max(behind) == 1  # a body's plate stays a plate


def test_the_same_lessons_teach_the_same(monkeypatch):
    monkeypatch.setattr(part_lessons, "_STEPS", 2)
    networks = [teach_parts(*_chests(4, seed=4), JOINTS).state_dict() for _ in range(2)]
    for name, value in networks[0].items():
        torch.testing.assert_close(value, networks[1][name])
