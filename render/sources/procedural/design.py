"""What a procedural generator returns: solids by part name and the joints between them, at joint coordinate zero."""

from __future__ import annotations

from dataclasses import dataclass

from manifold3d import Manifold


@dataclass(frozen=True)
class JointDesign:
    """A joint between named parts at coordinate zero: closed doors, lids and drawers, open legs."""

    name: str
    type: int
    parent: str
    child: str
    axis: tuple[float, float, float]
    pivot: tuple[float, float, float]


@dataclass(frozen=True)
class Design:
    """Solids by part name and their joints, all at joint coordinate zero, in the object frame in metres."""

    parts: dict[str, Manifold]
    joints: tuple[JointDesign, ...]
