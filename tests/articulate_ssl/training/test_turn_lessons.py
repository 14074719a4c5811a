"""What the collection says of training clouds teaches a network; which turns it sees, and when it is not asked."""

import pytest
import torch
from tiny import POINTS, tiny_module

from articulate_ssl.inference.options import InferenceOptions
from articulate_ssl.training import turn_lessons
from articulate_ssl.training.turn_lessons import learn_turns


def test_the_leading_turns_are_taught_the_likeliest_as_right(monkeypatch):
    module, handed = tiny_module(joint_type="prismatic").eval(), []
    clouds = torch.rand(20, POINTS, 3, generator=torch.Generator().manual_seed(0))
    turn = torch.linalg.qr(torch.randn(20, 4, 3, 3, generator=torch.Generator().manual_seed(1))).Q
    shown = iter(turn.split(16))
    monkeypatch.setattr(module.sliding, "leading_turns", lambda some: (next(shown), torch.zeros(len(some), 4)))
    monkeypatch.setattr(turn_lessons, "learn_surface", lambda *lesson: handed.append(lesson))
    learn_turns(module, clouds)
    ((versions, frames, order, least),) = handed
    assert torch.equal(versions[0], clouds) and not torch.equal(versions[1], clouds)
    assert (versions[1] - clouds).abs().max() < 0.06
    assert torch.equal(frames, turn.mT) and order.sort().values.tolist() == list(range(20))
    assert least == 0.9


@pytest.mark.parametrize("options", [{}, {"orientation_range": 60.0}, {"inference": InferenceOptions(refine=False)}])
def test_nothing_is_learnt_where_no_collection_says_anything(monkeypatch, options):
    module = tiny_module(joint_type="prismatic", **options)
    if options:
        module.sliding.gallery = torch.zeros(3, 8, 3)
    clouds = type("Clouds", (), {"clouds": lambda *_: pytest.fail("asked for clouds")})()
    module.learn_what_predictions_are_worth(clouds, ("turns",))
    assert module.sliding.surface is None
