"""What slides into a part shows that the part is hollow there, although no scan sees it.

Meshes around points are filled wherever no point is, and the drawers of a chest would lie inside a solid block. The
space through which a sliding part moves is free (space carving, by motion instead of by sight), so it is taken out of
the part that it slides on.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import trimesh

# Share of a sliding part's volume that lies in the other at an end of its range; below, they only touch. As
# `physics_check.OVERLAP_WORTH_A_NOTE`: reconstructions are no more exact than that.
INSIDE = 0.02
# Of the largest piece's volume: what a cut leaves of a bulge is smaller, and no part of the object. Chosen without a
# measurement, as are the next two.
SPLINTER = 0.01
# Less than this share of a part is no part any more: what was found to slide through it is wrong.
LEFT = 0.02
# Of the sweep's size, by which it is cut out wider, so that what slides does not scrape.
CLEARANCE = 0.002


class Slide(NamedTuple):
    """A part that slides on another.

    Attributes:
        parent: Number of the part that stays.
        child: Number of the part that moves.
        axis: [3] unit.
        lower: Lowest state.
        upper: Highest state.
    """

    parent: int
    child: int
    axis: np.ndarray
    lower: float
    upper: float


def hollow_parents(
    meshes: Sequence[trimesh.Trimesh],  # closed, of all parts, in one space while all states are zero
    slides: Iterable[Slide],
) -> list[trimesh.Trimesh]:
    """The meshes, without what slides through them; those through which nothing slides are the same objects."""
    slides = list(slides)
    result = list(meshes)
    for parent in {slide.parent for slide in slides}:
        inside = [s for s in slides if s.parent == parent and lies_inside(meshes[s.child], meshes[parent], s)]
        result[parent] = closed_difference(meshes[parent], [swept(meshes[slide.child], slide) for slide in inside])
    return result


def lies_inside(mesh: trimesh.Trimesh, other: trimesh.Trimesh, slide: Slide) -> bool:
    """Whether the other part more than touches a mesh that slides, at an end of its range."""
    unit = _size(mesh, other)
    fixed = other.copy().apply_scale(1 / unit)
    for state in (slide.lower, slide.upper):
        moved = mesh.copy().apply_translation(state * slide.axis).apply_scale(1 / unit)
        if shared_volume(moved, fixed) > INSIDE * moved.volume:
            return True
    return False


def swept(mesh: trimesh.Trimesh, slide: Slide) -> trimesh.Trimesh:
    """The convex hull of what a mesh moves through, and a little more."""
    ends = np.concatenate([mesh.vertices + state * slide.axis for state in (slide.lower, slide.upper)])
    middle = (ends.min(axis=0) + ends.max(axis=0)) / 2
    return trimesh.convex.convex_hull(middle + (1 + CLEARANCE) * (ends - middle))


def closed_difference(
    mesh: trimesh.Trimesh,  # closed
    others: Sequence[trimesh.Trimesh],  # closed, in the same space
) -> trimesh.Trimesh:
    """A closed mesh without the others; the mesh itself where there are none, or nothing would be left.

    Its vertices are float32 numbers, so that a file of such numbers is as closed.
    """
    if not others:
        return mesh
    unit = _size(mesh, *others)
    whole = mesh.copy().apply_scale(1 / unit)
    left = trimesh.boolean.difference(
        [whole, *(other.copy().apply_scale(1 / unit) for other in others)], check_volume=False
    )
    # The unit is a power of two and changes no digit.
    left = trimesh.Trimesh(np.asarray(left.vertices, dtype=np.float32).astype(np.float64), left.faces)
    left.merge_vertices()
    left.update_faces(left.nondegenerate_faces())
    pieces = [piece for piece in left.split(only_watertight=True) if piece.is_volume]
    if sum(piece.volume for piece in pieces) < LEFT * whole.volume:
        return mesh
    least = SPLINTER * max(piece.volume for piece in pieces)
    return trimesh.util.concatenate([piece for piece in pieces if piece.volume >= least]).apply_scale(unit)


def shared_volume(mesh: trimesh.Trimesh, other: trimesh.Trimesh) -> float:
    """Of two closed meshes."""
    with np.errstate(divide="ignore", invalid="ignore"):  # where two only touch
        return float(trimesh.boolean.intersection([mesh, other], check_volume=False).volume)


def _size(*meshes: trimesh.Trimesh) -> float:
    """What brings coordinates near one, which is what tolerances of the libraries are made for."""
    return 2.0 ** np.ceil(np.log2(max(np.abs(mesh.bounds).max() for mesh in meshes)))
