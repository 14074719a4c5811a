"""Doors of which half are upside down say which, whatever their sizes."""

import math

import numpy as np
import pytest
import roma
import torch
from boxes_with_doors import on_box
from torch.nn import functional

from articulate_ssl.inference.hinge_sides import Bodies
from articulate_ssl.training.upside_down import standing_out, upside_down


def _doors(turned: torch.Tensor, seed: int = 0) -> Bodies:
    """Doors of all sizes with a lock above the middle and a handle below; about them nothing else is seen."""
    generator, clouds, frames = torch.Generator().manual_seed(seed), [], []
    for half_turned in turned:
        size = torch.tensor([0.4, 0.3, 0.02]) * (0.8 + 0.4 * torch.rand(3, generator=generator))
        slab = on_box(size, 600, generator)
        lock = on_box(torch.tensor([0.05, 0.04, 0.02]), 84, generator) + size * torch.tensor([0.45, 0.3, -1.0])
        handle = on_box(torch.tensor([0.03, 0.12, 0.04]), 84, generator) + size * torch.tensor([-0.4, 0.3, -1.0])
        points = torch.cat([slab, lock, handle]) + 0.002 * torch.randn(768, 3, generator=generator)
        # Upside down, and so a mirror image, as its hinge is predicted where that of all others is.
        points = points * torch.tensor([-1.0 if half_turned else 1.0, 1.0, 1.0])
        turn = roma.unitquat_to_rotmat(functional.normalize(torch.randn(4, generator=generator), dim=0))
        clouds.append(points @ turn.T)
        frames.append(turn)
    steps = roma.rotvec_to_rotmat(torch.arange(4)[:, None] * torch.tensor([0.0, 0.0, math.pi / 2]))
    points, frame = torch.stack(clouds)[None], torch.stack(frames)
    known = torch.ones(len(turned)) > 0
    return Bodies(points, torch.zeros(1, *points.shape[1:3], 37), frame[:, None] @ steps, frame[..., 2], known)


@pytest.mark.parametrize("share", [0.5, 0.2])
def test_which_are_upside_down_shows_up_to_one_sign(share):
    turned = torch.rand(150, generator=torch.Generator().manual_seed(1)) < share
    said = upside_down(_doors(turned)).bool()
    assert max(float((said == turned).double().mean()), float((said != turned).double().mean())) > 0.95


def test_what_stands_out_is_where_it_is_and_the_other_way_up_on_a_mirrored_door():
    one, other = standing_out(_doors(torch.tensor([False]))), standing_out(_doors(torch.tensor([True])))
    torch.testing.assert_close(one.flip(1), other, atol=0.006, rtol=0)
    assert one.shape == (1, 6, 4)
    low, high = divmod(int(one[0].argmax()), 4)  # the handle stands out most: below the middle, away from the hinge
    assert low < 3 and high >= 2
    assert (one[0] > 0.01).sum() < 12


def test_doors_that_are_all_alike_are_not_parted():
    doors = _doors(torch.tensor([False]))
    same = Bodies(doors.points.expand(-1, 60, -1, -1), doors.surface, doors.frames.expand(60, -1, -1, -1), *doors[3:])
    with np.errstate(divide="raise", invalid="raise"):
        said = upside_down(same)
    assert (said == said[0]).all()
