"""What each proposal proposes."""

import torch
from articulated_objects import OVEN, clouds

from articulate_ssl.discovery.options import DiscoveryOptions
from articulate_ssl.discovery.proposals import Scene, restless_points
from articulate_ssl.discovery.proposals.random_cuts import random_split
from articulate_ssl.discovery.proposals.slabs import slab_cuts
from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.shape.observation import Observation


def test_random_splits_have_k_nonempty_parts():
    generator = torch.Generator().manual_seed(0)
    for parts in (2, 3, 4):
        label = random_split(torch.rand(100, 3), parts, generator)
        assert set(label.tolist()) <= set(range(parts)) and label.bincount(minlength=parts).max() < 90


def test_slabs_lie_at_the_ends_of_a_box():
    box = torch.rand(1000, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 2.0, 3.0])
    for parts in (2, 3):
        labels = slab_cuts(box, parts, torch.Generator().manual_seed(0))
        assert len(labels) == 12
        for label in labels:
            assert label.unique().tolist() == list(range(parts))
            slab = box[label > 0]
            assert 0.09 < len(slab) / len(box) < 0.21
            # Thin along one axis, at one of its ends.
            extent = (slab.amax(dim=0) - slab.amin(dim=0)) / box.amax(dim=0)
            assert extent.min() < 0.3 and (extent > 0.9).sum() == 2


def test_the_points_of_a_small_moving_part_are_restless():
    data = clouds(OVEN, count=16, points=768, resample=True, rotate=False, proportions=0.1, seed=1)
    rows = torch.cat([(data.part == 0).nonzero()[:, 0], (data.part == 1).nonzero()[::4, 0]])
    points, door = data.points[:, rows], data.part[rows] == 1
    half_open = points[data.state[:, 0].sub(1).abs().argmin()]
    generator = torch.Generator().manual_seed(0)
    scene = Scene(half_open, points, 2, REVOLUTE, DiscoveryOptions(cycles=12), Observation(), generator)
    smallest = restless_points.propose(scene)[0].label
    assert door.float().mean() < 0.25
    assert door[smallest == 1].float().mean() > 0.9
