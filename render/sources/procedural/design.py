"""What a procedural generator returns: solids by part name and the joints between them, at joint coordinate zero."""

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


def hinge(name: str, child: int, axis: Sequence[float], pivot: Sequence[float], upper_deg: float) -> Joint:
    """Revolute joint of the first part and another, from 0 to `upper_deg` degrees."""
    axis, pivot = np.asarray(axis, dtype=float), np.asarray(pivot, dtype=float)
    return Joint(name, REVOLUTE, 0, child, axis, pivot, lower=0.0, upper=float(np.deg2rad(upper_deg)))


def slide(name: str, child: int, axis: Sequence[float], pivot: Sequence[float], travel: float) -> Joint:
    """Prismatic joint of the first part and another, from 0 to `travel` metres."""
    axis, pivot = np.asarray(axis, dtype=float), np.asarray(pivot, dtype=float)
    return Joint(name, PRISMATIC, 0, child, axis, pivot, lower=0.0, upper=travel)
