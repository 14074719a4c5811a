"""Doors that predictions know are closed in their clouds, and a network learns which way round boxes then are."""

import pytest
import torch
from predicted_boxes import REST, predicted_boxes, predicting_module

from articulate_ssl.discovery.manhattan_frame import manhattan_frames
from articulate_ssl.inference.surface_decision import SurfaceDecision
from articulate_ssl.network.surface_network import SurfaceSize
from articulate_ssl.training import box_lessons, surface_lessons
from articulate_ssl.training.box_lessons import doors_closed_further, learn_box_turns

TINY = SurfaceSize(read=64, centers=32, dims=(16, 16), radii=(0.3, 0.5), num_neighbors=8, global_dim=32, head_dim=32)


def test_doors_turn_about_their_hinges_towards_a_closed_door():
    found, dense, inside = predicted_boxes(200)
    closed = doors_closed_further(found, dense, REST, torch.Generator().manual_seed(0))
    door = found.dense_part_id == 1
    assert torch.equal(closed[~door], dense[~door]) and door.double().mean() > 0.2
    frame = found.base_pose[:, :3, :3]
    after = (closed - found.base_pose[:, None, :3, 3]) @ frame
    y, z = (torch.where(door, after[..., k], 0).sum(1) / door.sum(1) for k in (1, 2))
    angle = torch.atan2(-(z + 0.26), -(y - 0.3))  # of the door's middle about its hinge
    assert angle.min() > -0.01 and angle.max() < 1.21
    nearly = (angle < 0.15 * 1.2 + 0.01).double().mean()
    assert 0.45 < nearly < 0.7 and (angle > 0.6).any() and (angle < 0.05).any()
    across = (after - inside)[..., 0]
    torch.testing.assert_close(across, torch.zeros_like(across), atol=1e-5, rtol=0)


def test_a_network_learns_which_way_round_boxes_with_closed_doors_are(monkeypatch):
    """No box that taught it was closed."""
    for name, value in {"SIZE": TINY, "FEWEST": 40, "TIMES": 60}.items():
        monkeypatch.setattr(surface_lessons, name, value)
    monkeypatch.setattr(box_lessons, "FEWEST", 40)
    found, dense, _ = predicted_boxes(120)
    module = predicting_module(found, dense)
    learn_box_turns(module, dense)
    turns = module.estimator.box_turns
    assert turns.learnt and module.estimator.square_search.measured
    found, closed, _ = predicted_boxes(40, opened=0.0)
    frames, _ = manhattan_frames(closed, torch.Generator().manual_seed(0))
    rotation, likely, *_ = turns.looks(closed, frames, torch.eye(3)[None])
    rotation = rotation[torch.arange(len(closed)), likely.argmax(dim=1)]
    right = (rotation * found.base_pose[:, :3, :3]).sum(dim=(1, 2)) > 2.8
    assert right.double().mean() > 0.9 and right[likely.amax(dim=1).exp() > 0.9].double().mean() > 0.95


@pytest.mark.parametrize("known, count", [(False, 120), (True, 40)])
def test_what_is_no_box_or_hardly_seen_teaches_nothing(monkeypatch, known, count):
    found, dense, _ = predicted_boxes(count)
    module = predicting_module(found, dense, known)
    module.estimator.box_turns.surface = SurfaceDecision()  # of a run that ended and goes on
    monkeypatch.setattr(module.estimator, "predict", lambda *_, **__: pytest.fail("predicted in vain"))
    learn_box_turns(module, dense)
    assert not module.estimator.box_turns.learnt
