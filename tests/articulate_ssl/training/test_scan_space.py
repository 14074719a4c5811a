"""Views of what was found in another canonical space are told as the category is."""

from dataclasses import replace

import numpy as np
import pytest
import roma
import torch
from boxes_with_doors import ZERO
from scanned_boxes import POINTS, SEEN, found_elsewhere, module_of_boxes

from articulate_ssl.discovery import reshaping
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.ops.chamfer import nearest_distance
from articulate_ssl.training import scan_space
from articulate_ssl.training.scan_space import ScanSpace


@pytest.fixture
def module():
    return module_of_boxes()


@pytest.mark.parametrize("seed", range(2))
def test_the_categorys_space_is_found_in_another(module, seed):
    turn = roma.random_rotmat(generator=torch.Generator().manual_seed(seed))
    frame = se3(turn, torch.tensor([0.1, -0.2, 0.05]))
    found = found_elsewhere(module.scans, frame).found
    parts = [(module.shape.label == part).nonzero()[::step, 0] for part, step in ((0, 3), (1, 1))]  # 200 points of each
    rows = torch.cat(parts)
    shape = replace(module.shape, points=module.shape.points[rows], label=module.shape.label[rows])
    space = ScanSpace.of(shape, replace(found, shape=found.shape.scaled(3.0)), module.states.starts())
    torch.testing.assert_close(space.frame, frame, atol=0.02, rtol=0)
    states = torch.tensor([[ZERO], [ZERO + 0.3], [ZERO + 1.0]])
    torch.testing.assert_close(space.found_states(states), torch.tensor([[0.3], [0.0], [-0.7]]), atol=0.03, rtol=0)
    torch.testing.assert_close(space.states(space.found_states(states)), states)


def test_the_categorys_shape_is_where_it_is_in_views(module, monkeypatch):
    monkeypatch.setattr(reshaping, "_SPREAD", 0.0)  # of the very object, whose shape is known
    turn = roma.random_rotmat(generator=torch.Generator().manual_seed(3))
    scans = found_elsewhere(module.scans, se3(turn, torch.zeros(3)))
    space = ScanSpace.of(module.shape, scans.found, module.states.starts())
    limits = torch.tensor([ZERO, SEEN[0]])
    views, found = space.views(scans, POINTS, np.random.default_rng(0), 3, limits)
    assert torch.equal(found.shape.points, module.shape.points) and len(views) == len(found.base) == len(found.state)
    assert found.state.min() > ZERO - 0.05 and found.state.max() < SEEN[0] + 0.05 and found.state.std() > 0.15
    size = torch.linspace(0.5, 2.5, 101)  # by which views are normalised
    for one, view in enumerate(views):
        placed = module.shape.posed(torch.eye(4)[None], found.state[one, None])
        inside = (view - found.base[one, :3, 3]) @ found.base[one, :3, :3]
        off = nearest_distance(inside / size[:, None, None], placed.expand(len(size), -1, -1)).mean(dim=1)
        assert off.min() < 0.01


def test_states_are_those_in_which_doors_are_square_to_their_faces(module, monkeypatch):
    monkeypatch.setattr(scan_space, "_AT_ONCE", 4)  # not all of them at once
    scans = found_elsewhere(module.scans, se3(torch.eye(3), torch.tensor([0.1, -0.2, 0.05])))
    wrong = torch.linspace(-12, 12, len(scans.clouds)).deg2rad()[:, None]
    module.scans = replace(scans, found=replace(scans.found, state=scans.found.state + wrong))
    squared, _ = ScanSpace.of_scans(module, None, "test")
    closed = squared.found.state - scans.found.state
    assert (closed - closed.median()).rad2deg().abs().max() < 2  # the category's zero is where most scans are
    assert torch.equal(squared.found.base, scans.found.base)
