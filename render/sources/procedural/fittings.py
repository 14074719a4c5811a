"""Handles, knobs and feet, shared by the furniture and appliances. They stand on a face that looks towards +z."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from manifold3d import Manifold

from render.sources.procedural.shapes import box, cylinder, rounded_box, union

OVERLAP = 5e-4  # fused solids share this much, so that no two of their faces coincide


def bar_handle(
    center: Sequence[float], along: str, length: float, standoff: float, radius: float, square: bool
) -> Manifold:
    """Round or flat bar along "x" or "y" on two posts; `center` lies on the face behind it."""
    center = np.asarray(center, dtype=float)
    axis = "xyz".index(along)
    bar = center + np.array([0.0, 0.0, standoff])
    ends = [center.copy(), center.copy()]
    ends[0][axis] -= 0.42 * length
    ends[1][axis] += 0.42 * length
    solids = []
    for end in ends:
        solids.append(cylinder(end, "z", center[2] - OVERLAP, bar[2], 0.8 * radius, segments=12))
    if square:
        half = np.full(3, radius)
        half[axis], half[2] = length / 2, 0.7 * radius
        solids.append(rounded_box(bar - half, bar + half, along, 0.4 * radius, segments=12))
    else:
        low, high = bar[axis] - length / 2, bar[axis] + length / 2
        solids.append(cylinder(bar, along, low, high, radius, segments=16))
    return union(solids)


def knob(center: Sequence[float], radius: float, height: float, pointer: float | None) -> Manifold:
    """Turning or pulling knob on a skirt; `pointer` is the angle of a grip ridge across its top, if it has one."""
    x, y, z = center
    skirt = cylinder(center, "z", z - OVERLAP, z + 0.25 * height, radius)
    cap = cylinder(center, "z", z, z + height, 0.86 * radius, 0.76 * radius)
    if pointer is None:
        return union([skirt, cap])
    ridge = box((-0.14 * radius, -0.72 * radius, 0.5 * height), (0.14 * radius, 0.72 * radius, 1.3 * height))
    return union([skirt, cap, ridge.rotate((0, 0, float(np.rad2deg(pointer)))).translate((x, y, z))])


def feet(
    half_width: float, back: float, front: float, top: float, height: float, radius: float, square: bool
) -> list[Manifold]:
    """Four feet below the plane y = `top`, at x = ± `half_width` and z = `back` and `front`; tapered if round."""
    solids = []
    for x in (-half_width, half_width):
        for z in (back, front):
            if square:
                solids.append(box((x - radius, top - height, z - radius), (x + radius, top + OVERLAP, z + radius)))
            else:
                solids.append(cylinder((x, 0, z), "y", top - height, top + OVERLAP, 0.75 * radius, radius))
    return solids
