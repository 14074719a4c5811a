"""Scans of a simple drawer for the tests of twins, and no more effort on them than they need."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from articulated_objects import DRAWER, Clouds, clouds, true_shape
from torch import Tensor

from articulate_ssl.discovery import distance_field
from articulate_ssl.discovery.one_object import find
from articulate_ssl.discovery.one_object.find import OneObject
from articulate_ssl.discovery.proposals import slides

SCALE, APART = 400.0, np.array([50.0, -10.0, 900.0])


def drawer() -> Clouds:
    """Eight clouds."""
    return clouds(DRAWER, count=8, points=2048, resample=True, seed=1)


def scans(data: Clouds) -> list[np.ndarray]:
    """The clouds as scans in other units, each somewhere else."""
    return [cloud.double().numpy() * SCALE + APART * i for i, cloud in enumerate(data.points)]


def with_little_effort(patch: pytest.MonkeyPatch) -> None:
    """What such objects need of discovery."""
    with_coarse_slides(patch)
    patch.setattr(find, "_EFFORT", {"starts": 3, "jointed": 2, "rounds": 1, "cycles": 3, "edge_hinges": False})
    patch.setattr(find, "_REFERENCES", (1,))


def with_coarse_slides(patch: pytest.MonkeyPatch) -> None:
    """A grid of an eighth of the cells, and a quarter of the restarts, in the search for what slides."""
    patch.setattr(distance_field, "_CELLS", 48)
    patch.setattr(slides, "_RESTARTS", 10)


def true_object(points: Tensor, num_parts: int, joint_type: int, seed: int = 0, labelled: int = 4096) -> OneObject:
    """The drawer as it is, in place of `find_one_object`, for tests of what is done with it."""
    data = drawer()
    size = (points.norm(dim=-1).mean() / data.points.norm(dim=-1).mean()).double()  # in normalised units
    shape, base, state = true_shape(DRAWER, data), data.base.double(), data.state.double() * size
    base[:, :3, 3] *= size
    limits = torch.stack([state.amin(dim=0), state.amax(dim=0)], dim=-1)
    joints = replace(shape.joints, axis=data.axis.double(), pivot=data.pivot.double() * size, limits=limits)
    shape = replace(shape, points=shape.points.double() * size, joints=joints)
    posed = shape.posed(base, state)
    label = shape.label[torch.cdist(points[:, :labelled].double(), posed).argmin(dim=-1)]
    share = torch.nn.functional.one_hot(label, num_parts).double()
    return OneObject(shape, base, state, label, share, torch.zeros(label.shape))
