"""Clouds of more objects are kept, of those that are understood; what is not asked for finds none."""

import pytest
import torch
from tiny import POINTS, tiny_module

from articulate_ssl.discovery.discover import DiscoveryError
from articulate_ssl.discovery.similar_clouds import LabelledClouds
from articulate_ssl.training import part_lessons
from articulate_ssl.training.lessons import teach
from articulate_ssl.training.object_lessons import learn_objects

# Nine clouds of object 5, three of object 6, eight of objects 2 and 4.
STACK = ((0.0, 0.4, 0.3), (0.0, 0.1, 0.3), (0.0, -0.3, 0.3))  # z points to the front
ROW = ((-0.5, 0.3, 0.3), (0.0, 0.3, 0.3), (0.5, 0.3, 0.3))
INSTANCE = torch.tensor([5, 2, 4] * 8 + [5, 6, 6, 6])


@pytest.fixture
def module(monkeypatch):
    """One that understands every object but 4, as clouds that say which object they show."""
    module = tiny_module(joint_type="prismatic").eval()

    def understood(chain, clouds):
        assert chain == module.articulated.category.chain() and len(clouds) == 8
        if (clouds == 4).all():
            raise DiscoveryError("not this one")
        return LabelledClouds(clouds, (torch.arange(POINTS) % 2).expand(8, POINTS)), torch.eye(3).expand(8, 3, 3)

    monkeypatch.setattr(module.sliding, "understood", understood)
    monkeypatch.setattr(part_lessons, "_STEPS", 2)
    return module


def _clouds() -> torch.Tensor:
    return INSTANCE[:, None, None].expand(-1, POINTS, 3).float()


def test_clouds_of_what_is_understood_take_the_place_of_fewer(module, caplog):
    module.sliding.learn_labelled(LabelledClouds(torch.rand(15, POINTS, 3), torch.zeros(15, POINTS)))
    caplog.set_level("INFO")
    learn_objects(module, _clouds(), INSTANCE)
    sliding = module.sliding
    kept = sliding.labelled.float() * sliding.step[:, None, None]
    assert sorted(kept[:, 0, 0].round().int().tolist()) == [2] * 8 + [5] * 8
    assert (sliding.part.long() == torch.arange(POINTS) % 2).all()
    assert torch.equal(module.states.limits, sliding.limits)
    assert sliding.parts.num_parts == 2 and not any(p.requires_grad for p in sliding.parts.parameters())
    assert "parts of 2 of 3 objects are understood" in caplog.text and "not this one" in caplog.text


def test_parts_of_rare_kinds_are_called_as_in_others(monkeypatch):
    """Of a desk among chests, whose drawers the others called in another order."""
    module = tiny_module(joint_type="prismatic", num_parts=4).eval()
    monkeypatch.setattr(part_lessons, "_STEPS", 2)
    label = (torch.arange(POINTS) % 4).expand(8, POINTS)
    stack, row = (torch.tensor([[0.0, 0, 0], *places]) for places in (STACK, ROW))
    odd = torch.tensor([0, 2, 3, 1])
    monkeypatch.setattr(
        module.sliding,
        "understood",
        lambda chain, clouds: (
            LabelledClouds(row[odd][label] if (clouds == 4).all() else stack[label], label),
            torch.eye(3).expand(8, 3, 3),
        ),
    )
    learn_objects(module, _clouds(), INSTANCE)
    sliding = module.sliding
    desk = sliding.labelled[:, :, 0].float().std(dim=1) > 0
    assert int(desk.sum()) == 8 and torch.equal(sliding.part[~desk].long(), label.repeat(2, 1))
    told = sliding.part[desk].long()
    assert torch.equal(told, odd[label]) or torch.equal(told, torch.tensor([0, 3, 2, 1])[odd][label])


def test_what_there_is_stays_where_no_more_is_understood(module):
    module.sliding.learn_labelled(LabelledClouds(torch.rand(18, POINTS, 3), torch.zeros(18, POINTS)))
    before = module.sliding.labelled.clone()
    learn_objects(module, _clouds(), INSTANCE)
    assert torch.equal(module.sliding.labelled, before) and module.sliding.parts is None


def test_whole_objects_are_asked_for_where_discovery_found_some(module, monkeypatch):
    asked = []

    class Clouds:
        def objects(self, count):
            asked.append(count)
            return _clouds(), INSTANCE

    teach(module, Clouds(), ("objects",))
    assert not asked
    module.sliding.learn_labelled(LabelledClouds(torch.rand(1, POINTS, 3), torch.zeros(1, POINTS)))
    teach(module, Clouds(), ("objects",))
    assert asked == [1200] and len(module.sliding.labelled) == 16
