"""Scans of a simple drawer for the tests of twins, and no more effort on them than they need."""

import numpy as np
import pytest
from articulated_objects import DRAWER, Clouds, clouds

from articulate_ssl.discovery import distance_field
from articulate_ssl.discovery.one_object import find
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
