"""What the collection says of training clouds teaches a network; which turns it sees, and when it is not asked."""

import pytest
import roma
import torch
from articulated_objects import CHEST, clouds
from tiny import POINTS, tiny_module

from articulate_ssl.discovery.synchronization import unit_boxes
from articulate_ssl.inference.options import InferenceOptions
from articulate_ssl.training import turn_lessons
from articulate_ssl.training.lessons import teach
from articulate_ssl.training.turn_lessons import learn_turns, learn_view_turns


def test_the_turn_of_the_clouds_most_alike_is_taught_as_right_and_the_search_goes_by_it(monkeypatch):
    module, handed = tiny_module(joint_type="prismatic").eval(), []
    points = torch.rand(20, POINTS, 3, generator=torch.Generator().manual_seed(0))
    turn = torch.linalg.qr(torch.randn(20, 4, 3, 3, generator=torch.Generator().manual_seed(1))).Q
    shown, chosen = iter(turn[:12].split(16) + turn.split(16)), torch.zeros(20, dtype=torch.long)
    chosen[3] = 2
    monkeypatch.setattr(turn_lessons, "_FEW", 12)
    monkeypatch.setattr(module.sliding, "leading_turns", lambda some: (next(shown), torch.zeros(len(some), 4)))
    monkeypatch.setattr(turn_lessons, "turned_as_the_alike", lambda turns, _: chosen[: len(turns)])
    monkeypatch.setattr(turn_lessons, "learn_surface", lambda *lesson: handed.append(lesson))
    learn_turns(module, points)
    ((versions, frames, order, least),) = handed
    assert torch.equal(versions[0], points) and not torch.equal(versions[1], points)
    assert (versions[1] - points).abs().max() < 0.06
    right_first = turn.clone()
    right_first[3] = turn[3, [2, 0, 1, 3]]
    standing = unit_boxes(points @ right_first[:, 0].mT)[0]
    assert torch.equal(module.sliding.gallery, standing[:, : module.sliding.gallery.shape[1]])
    assert torch.equal(frames, right_first.mT) and order.sort().values.tolist() == list(range(20))
    assert least == 0.9


def test_of_the_turns_that_are_square_those_that_are_held_to_be_right_are_taught(monkeypatch):
    module, handed = tiny_module(num_parts=3, joint_type="prismatic").eval(), []
    frame, data = module.object_frame, clouds(CHEST, count=18, points=2048, resample=True)
    views = data.points.clone()
    views[17] = 0.2 * torch.randn(2048, 3, generator=torch.Generator().manual_seed(0))  # which has no frame
    held = module.articulated.category_at(data.base[:, None], data.state[:, None])
    monkeypatch.setattr(turn_lessons, "explain", lambda *_: held)
    monkeypatch.setattr(turn_lessons, "learn_surface", lambda *lesson: handed.append(lesson))
    learn_view_turns(module, views)
    assert not handed  # it is not known how frames lie
    frame.known.fill_(True)
    learn_view_turns(module, views)
    ((versions, frames, order, least),) = handed
    assert torch.equal(versions[0], views) and least == 0.9
    assert order.sort().values.tolist() == list(range(17))
    assert frames.shape == (18, 24, 3, 3)
    off = roma.rotmat_geodesic_distance(frames, data.base[:, None, :3, :3].expand_as(frames)).rad2deg()[:17]
    assert off[:, 0].max() < 5 and off[:, 1:].min() > 80


@pytest.mark.parametrize("options", [{}, {"orientation_range": 60.0}, {"inference": InferenceOptions(refine=False)}])
def test_nothing_is_learnt_where_no_collection_says_anything(monkeypatch, options):
    module = tiny_module(joint_type="prismatic", **options)
    if options:
        module.sliding.gallery = torch.zeros(3, 8, 3)
    shown = type("Clouds", (), {"clouds": lambda *_: pytest.fail("asked for clouds")})()
    teach(module, shown, ("turns", "view_turns"))
    assert module.sliding.surface is None and module.object_frame.surface is None
