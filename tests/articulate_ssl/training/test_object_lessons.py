"""Clouds of more objects are kept, of those that are understood; what is not asked for finds none."""

import pytest
import torch
from tiny import POINTS, tiny_module

from articulate_ssl.discovery.discover import DiscoveryError
from articulate_ssl.discovery.similar_clouds import LabelledClouds
from articulate_ssl.training.object_lessons import learn_objects

# Nine clouds of object 5, three of object 6, eight of objects 2 and 4.
INSTANCE = torch.tensor([5, 2, 4] * 8 + [5, 6, 6, 6])


@pytest.fixture
def module(monkeypatch):
    """One that understands every object but 4, as clouds that say which object they show."""
    module = tiny_module(joint_type="prismatic").eval()

    def understood(chain, clouds):
        assert chain == module.articulated.category.chain() and len(clouds) == 8
        if (clouds == 4).all():
            raise DiscoveryError("not this one")
        return LabelledClouds(clouds, clouds[..., 0].long() % 2)

    monkeypatch.setattr(module.sliding, "understood", understood)
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
    assert torch.equal(sliding.part[:, 0].float(), kept[:, 0, 0].round() % 2)
    assert "parts of 2 of 3 objects are understood" in caplog.text and "not this one" in caplog.text


def test_what_there_is_stays_where_no_more_is_understood(module):
    module.sliding.learn_labelled(LabelledClouds(torch.rand(16, POINTS, 3), torch.zeros(16, POINTS)))
    before = module.sliding.labelled.clone()
    learn_objects(module, _clouds(), INSTANCE)
    assert torch.equal(module.sliding.labelled, before)


def test_whole_objects_are_asked_for_where_discovery_found_some(module, monkeypatch):
    asked = []

    class Clouds:
        def objects(self, count):
            asked.append(count)
            return _clouds(), INSTANCE

    module.learn_what_predictions_are_worth(Clouds(), ("objects",))
    assert not asked
    module.sliding.learn_labelled(LabelledClouds(torch.rand(1, POINTS, 3), torch.zeros(1, POINTS)))
    module.learn_what_predictions_are_worth(Clouds(), ("objects",))
    assert asked == [1200] and len(module.sliding.labelled) == 16
