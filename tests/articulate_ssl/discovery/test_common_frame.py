"""Chests share a frame, with noise, too; what is round has none."""

import numpy as np
import pytest
import roma
import torch
from torch import Tensor

from articulate_ssl.discovery.common_frame import common_frame
from render.category import load_category
from render.complete_cloud import ReachableSurface
from render.posing import sample_states
from render.sources import open_source

_CHESTS = 4


def _chests() -> Tensor:  # [n, 4096, 3]
    """Closed and open generated chests, each drawer and the body of thin boards, as they stand."""
    spec, generator = load_category("drawer"), np.random.default_rng(0)
    source, clouds = open_source("procedural", spec, None, seed=5), []
    for instance_id in source.instance_ids()[:_CHESTS]:
        chest = spec.to_rest(source.load(instance_id))
        states = sample_states(spec.sampled_ranges(chest), 2, generator)
        surface = ReachableSurface(chest, states, generator, pool_size=8192)
        points = surface.cloud(chest.part_motion(states[0]), 4096, generator)[0]
        centred = points - points.mean(axis=0)
        clouds.append(torch.from_numpy(centred / np.ptp(centred, axis=0).max()).float())
    return torch.stack(clouds)


@pytest.mark.parametrize(("whole", "degrees"), [(True, 2), (False, 10)], ids=["whole", "views"])
@pytest.mark.parametrize("noise", [0.0, 0.005])
def test_generated_chests_share_a_frame(noise, whole, degrees):
    """Boards are thin: neighbours lie on their other sides, so that few neighbourhoods are planes."""
    generator = torch.Generator().manual_seed(0)
    torch.manual_seed(0)
    turn = roma.random_rotmat(_CHESTS)
    clouds = _chests()
    clouds = clouds @ turn.mT + noise * torch.randn(clouds.shape, generator=generator)
    frame = common_frame(clouds, generator, whole)
    assert frame is not None
    along = (frame @ turn).abs().amax(dim=-1)  # an axis of the frame, and the nearest along which chests are made
    assert along.min() > np.cos(np.deg2rad(degrees))


def test_what_is_round_shares_none():
    generator = torch.Generator().manual_seed(0)
    balls = torch.nn.functional.normalize(torch.randn(3, 4096, 3, generator=generator), dim=-1)
    assert common_frame(balls, generator) is None
