"""What a procedural generator returns: solids by part name and the joints between them; how its numbers are drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from manifold3d import Manifold

from articulate_ssl.geometry.screw import PRISMATIC, REVOLUTE
from render.articulated_object import Joint


@dataclass(frozen=True)
class Design:
    """Solids in the category's part order and their joints, all at joint coordinate zero: closed, or unfolded."""

    parts: dict[str, Manifold]
    joints: tuple[Joint, ...]


def hinge(
    name: str, child: int, axis: Sequence[float], pivot: Sequence[float], upper_deg: float, parent: int = 0
) -> Joint:
    """Revolute joint of two parts, from 0 to `upper_deg` degrees; the parent is the first part unless given."""
    axis, pivot = np.asarray(axis, dtype=float), np.asarray(pivot, dtype=float)
    return Joint(name, REVOLUTE, parent, child, axis, pivot, lower=0.0, upper=float(np.deg2rad(upper_deg)))


def slide(
    name: str, child: int, axis: Sequence[float], pivot: Sequence[float], travel: float, parent: int = 0
) -> Joint:
    """Prismatic joint of two parts, from 0 to `travel` metres; the parent is the first part unless given."""
    axis, pivot = np.asarray(axis, dtype=float), np.asarray(pivot, dtype=float)
    return Joint(name, PRISMATIC, parent, child, axis, pivot, lower=0.0, upper=travel)


def from_quantiles(rng: np.random.Generator, *values: float) -> float:
    """A number whose quantiles at even shares are `values`: minimum, quartiles and maximum if there are five.

    A measured distribution is spanned by its own quantiles, where a uniform one between its ends would mostly draw
    what is rare.
    """
    return float(np.interp(rng.random(), np.linspace(0.0, 1.0, len(values)), values))
