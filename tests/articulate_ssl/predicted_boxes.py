"""Predictions of boxes with doors, all of them right, and a module that makes them."""

from dataclasses import replace
from types import SimpleNamespace

import torch
from boxes_with_doors import ZERO, lying_boxes
from tiny import POINTS

from articulate_ssl.inference.box_turns import BoxTurns
from articulate_ssl.inference.hinge_sides import HingeSides
from articulate_ssl.inference.part_frames import PartFrames
from articulate_ssl.inference.state_range import StateRange

REST = torch.tensor([ZERO])


def predicted_boxes(count: int, opened: float = 1.2):
    """Predictions that are right, clouds, and which points are the door's."""
    found, dense, _ = lying_boxes([0] * count, opened)
    generator = torch.Generator().manual_seed(0)
    order = torch.rand(dense.shape[:2], generator=generator).argsort(dim=1)  # each shows other points first
    dense = dense.gather(1, order[..., None].expand(-1, -1, 3))
    # The door is the plate that turns: behind the closed door's plane nothing of it is.
    inside = (dense - found.base_pose[:, None, :3, 3]) @ found.base_pose[:, :3, :3]
    body = (inside[..., 2] > -0.2501) & (inside[..., 1].abs() < 0.39) & (inside[..., 0].abs() < 0.3001)
    return replace(found, dense_part_id=(~body).long()), dense, inside


class _Search:
    """Boxes whose doors are closed at `REST`, or something else."""

    def __init__(self, known: bool) -> None:
        self.known, self.measured = known, False

    def measure(self) -> None:
        self.measured = True


def predicting_module(found, dense, known: bool = True):
    """Its predictions are right."""
    part_frames = PartFrames(2)
    part_frames.axes.copy_(torch.tensor([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]]).expand(2, 3, 3))
    states, sides = StateRange(1), HingeSides()
    states.set_rest(ZERO + 0.5)
    sides.learnt.fill_(True)
    sides.closed.fill_(0.5)  # from where predictions count

    def predict(points, _count, dense):
        assert torch.equal(points, dense[:, :POINTS])
        return found[[int((every - dense[0, 0]).norm(dim=-1).amin(1).argmin()) for dense in dense[:, None]]]

    every = dense
    estimator = SimpleNamespace(
        box_turns=BoxTurns(), square_search=_Search(known), states=states, hinge_sides=sides, part_frames=part_frames
    )
    estimator.predict = predict
    return SimpleNamespace(estimator=estimator, num_points=POINTS, inference=SimpleNamespace(points=POINTS))
