"""Scans that lie in the frame of discovery are told by their bodies, if bodies tell, and stood up."""

from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
from boxes_with_doors import ZERO, TopIsUp, box_shape, lying_boxes

from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.geometry.screw import PRISMATIC
from articulate_ssl.training import lying_scans
from articulate_ssl.training.lying_scans import quarters_to_stand


def _scans(quarters: list[int], opened: Sequence[float]) -> tuple[RegisteredShape, torch.Tensor, torch.Tensor]:
    """Scans of objects that lie by so many quarters, registered; their clouds, and how canonical space truly stands."""
    prediction, dense, stands = lying_boxes(quarters)
    state = ZERO + torch.tensor(opened)[:, None]
    error = torch.arange(len(quarters)).float()
    found = RegisteredShape(box_shape(), prediction.base_pose, state, torch.zeros(len(quarters), 2, 3), error)
    return found, dense, stands


@pytest.fixture
def few_scans(monkeypatch):
    monkeypatch.setattr(lying_scans, "_FEWEST", 10)
    monkeypatch.setattr(lying_scans, "teach", lambda *_: TopIsUp())


def test_scans_that_lie_are_found_and_stood_up(few_scans):
    """Whether they fit well or not; but where the joint is beyond where others are, nothing is believed."""
    quarters = [0] * 14 + [3] + [0, 3, 1, 2, 3]
    opened = [0.8, 1.0, 1.2, 1.4, 1.6] * 3 + [1.2] * 4 + [3.0]
    found, dense, stands = _scans(quarters, opened)
    told, turn = quarters_to_stand(found, dense, torch.arange(15))
    assert told.tolist() == [*quarters[:-1], 0]
    torch.testing.assert_close((found.base[:, :3, :3] @ turn)[:-1], stands[:-1], atol=1e-4, rtol=0)
    torch.testing.assert_close(turn[-1], torch.eye(3))


def test_scans_stay_where_bodies_do_not_tell(few_scans, monkeypatch):
    found, dense, _ = _scans([0, 2, 1, 3] * 4, [1.2] * 16)  # half of those that are left out seem to lie
    assert quarters_to_stand(found, dense, torch.arange(16))[0].tolist() == [0] * 16
    found, dense, _ = _scans([3] * 2 + [0] * 14, [1.2] * 16)
    assert quarters_to_stand(found, dense, torch.arange(2, 16))[0].tolist() == [3] * 2 + [0] * 14
    monkeypatch.setattr(lying_scans, "teach", None)  # nothing is taught
    for best, cloud in ((torch.arange(9), dense), (torch.arange(16), dense[:, :600])):
        told, turn = quarters_to_stand(found, cloud, best)
        assert told.tolist() == [0] * 16
        torch.testing.assert_close(turn, torch.eye(3).expand(16, 3, 3))
    slides = replace(found, shape=replace(found.shape, joints=replace(found.shape.joints, joint_type=PRISMATIC)))
    assert quarters_to_stand(slides, dense, torch.arange(16))[0].tolist() == [0] * 16
