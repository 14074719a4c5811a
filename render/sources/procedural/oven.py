"""Ovens: a body with cavity, racks and control panel, and a bottom-hinged door with window and handle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from manifold3d import Manifold

from render.sources.procedural.design import Design, hinge
from render.sources.procedural.fittings import OVERLAP, bar_handle, feet, knob
from render.sources.procedural.shapes import box, cylinder, extrude, rounded_box, rounded_rectangle, subtract, union


@dataclass(frozen=True)
class OvenParameters:
    """Sizes in metres. The front, from top to bottom: control panel, door, plinth (which may be a storage drawer)."""

    width: float
    depth: float
    panel_height: float
    door_height: float
    plinth_height: float
    door_thickness: float
    corner: float
    wall: float
    window_width: float
    window_height: float
    window_corner: float
    handle_length: float
    handle_radius: float
    handle_standoff: float
    handle_square: bool
    knobs: int
    knob_radius: float
    knob_angles: tuple[float, ...]
    display: bool
    burners: bool
    backguard_height: float
    racks: int
    drawer_groove: bool
    foot_height: float
    foot_radius: float
    foot_square: bool


def sample(rng: np.random.Generator) -> OvenParameters:
    """Free-standing ranges, built-in ovens and small counter-top ovens."""
    kind = rng.choice(["range", "built_in", "counter_top"], p=[0.5, 0.3, 0.2])
    width = {
        "range": rng.uniform(0.50, 0.90),
        "built_in": rng.uniform(0.56, 0.62),
        "counter_top": rng.uniform(0.38, 0.52),
    }
    width = float(width[kind])
    door_height = width * rng.uniform(0.55, 0.85)
    knobs = int(rng.integers(2, 7 if kind == "range" else 4))
    panel_height = rng.uniform(0.08, 0.14)
    low_feet = kind == "counter_top" or rng.random() < 0.5
    return OvenParameters(
        width=width,
        depth=rng.uniform(0.50, 0.65) if kind != "counter_top" else rng.uniform(0.32, 0.42),
        panel_height=panel_height,
        door_height=door_height,
        plinth_height=rng.uniform(0.10, 0.22) if kind == "range" else rng.uniform(0.02, 0.05),
        door_thickness=rng.uniform(0.028, 0.05),
        corner=rng.uniform(0.0, 0.02),
        wall=rng.uniform(0.035, 0.06),
        window_width=width * rng.uniform(0.5, 0.74),
        window_height=door_height * rng.uniform(0.36, 0.56),
        window_corner=rng.choice([0.004, 0.02, 0.05]),
        handle_length=width * rng.uniform(0.55, 0.9),
        handle_radius=rng.uniform(0.008, 0.014),
        handle_standoff=rng.uniform(0.03, 0.055),
        handle_square=bool(rng.random() < 0.4),
        knobs=knobs,
        knob_radius=min(rng.uniform(0.016, 0.026), 0.3 * panel_height),
        knob_angles=tuple(rng.uniform(-1.0, 1.0, knobs)),
        display=bool(rng.random() < 0.5),
        burners=bool(kind == "range" and rng.random() < 0.8),
        backguard_height=rng.uniform(0.06, 0.18) if kind == "range" and rng.random() < 0.6 else 0.0,
        racks=int(rng.integers(1, 3)),
        drawer_groove=bool(kind == "range" and rng.random() < 0.7),
        foot_height=rng.uniform(0.015, 0.03) if low_feet else rng.uniform(0.06, 0.13),
        foot_radius=rng.uniform(0.016, 0.028),
        foot_square=bool(rng.random() < 0.4),
    )


def build(p: OvenParameters) -> Design:
    """Body and closed door. The hinge runs inside the lower edge of the door, which is rounded about it."""
    front = p.depth / 2
    roll = 0.2 * p.door_thickness
    gap = 0.002
    pivot = np.array([0.0, p.plinth_height + gap + roll, front + p.door_thickness - roll])
    return Design(
        parts={"body": _body(p, front, pivot[2] - roll - gap), "door": _door(p, front, pivot, roll, gap)},
        joints=(hinge("door_hinge", 1, (1.0, 0.0, 0.0), pivot, upper_deg=135.0),),
    )


def _body(p: OvenParameters, front: float, plinth_front: float) -> Manifold:
    """`plinth_front` leaves room for the door's lower edge, which turns over it."""
    w, t = p.width / 2, p.door_thickness
    door_top = p.plinth_height + p.door_height
    height = door_top + p.panel_height
    carcass = rounded_box((-w, 0, -front), (w, height, front), "z", p.corner)
    panel = rounded_box((-w, door_top, front - OVERLAP), (w, height, front + t), "z", p.corner, 0.003)
    plinth = rounded_box((-w, 0, front - OVERLAP), (w, p.plinth_height, plinth_front), "z", min(p.corner, 0.01), 0.003)
    cavity = rounded_box(
        (-w + p.wall, p.plinth_height + p.wall, -front + p.wall),
        (w - p.wall, door_top - p.wall, front + 1e-3),
        "z",
        0.015,
    )
    cuts = [cavity]
    if p.drawer_groove:
        y = 0.86 * p.plinth_height
        cuts.append(box((-w - 1e-3, y, plinth_front - 0.012), (w + 1e-3, y + 0.008, plinth_front + 1e-3)))
    if p.display:
        cuts.append(_panel_display(p, door_top, front + t))
    solids = [subtract(union([carcass, panel, plinth]), cuts), *_rack_bars(p, front)]
    solids += _knobs(p, door_top + p.panel_height / 2, front + t)
    solids += feet(w - 0.06, -front + 0.06, front - 0.04, 0.0, p.foot_height, p.foot_radius, p.foot_square)
    if p.burners:
        solids += _burners(p, height)
    if p.backguard_height:
        solids.append(
            rounded_box((-w, height - OVERLAP, -front), (w, height + p.backguard_height, -front + 0.05), "z", 0.01)
        )
    return union(solids)


def _panel_display(p: OvenParameters, door_top: float, z: float) -> Manifold:
    half, middle = 0.09 * p.width, door_top + p.panel_height / 2
    return rounded_box((-half, middle - 0.02, z - 0.003), (half, middle + 0.02, z + 1e-3), "z", 0.004)


def _knobs(p: OvenParameters, y: float, z: float) -> list[Manifold]:
    span = 0.40 * p.width
    xs = np.linspace(-span, span, p.knobs)
    if p.display:  # it takes the middle of the panel
        left, inner = (p.knobs + 1) // 2, 0.16 * p.width
        xs = [*np.linspace(-span, -inner, left), *np.linspace(inner, span, p.knobs - left)]
    return [
        knob((x, y, z), p.knob_radius, 1.1 * p.knob_radius, angle) for x, angle in zip(xs, p.knob_angles, strict=True)
    ]


def _rack_bars(p: OvenParameters, front: float) -> list[Manifold]:
    x, back, near = p.width / 2 - p.wall + 0.002, -front + p.wall - 0.002, front - 0.02
    low, high = p.plinth_height + p.wall, p.plinth_height + p.door_height - p.wall
    bar = 0.004
    bars = []
    for y in np.linspace(low, high, p.racks + 2)[1:-1]:
        for z in np.linspace(back + 0.02, near, 4):
            bars.append(box((-x, y - bar, z - bar), (x, y + bar, z + bar)))
        for u in np.linspace(-0.85 * x, 0.85 * x, 7):
            bars.append(box((u - 0.75 * bar, y - 0.75 * bar, back), (u + 0.75 * bar, y + 0.75 * bar, near)))
    return bars


def _burners(p: OvenParameters, y: float) -> list[Manifold]:
    burners = []
    for i, x in enumerate((-0.24 * p.width, 0.24 * p.width)):
        for j, z in enumerate((-0.22 * p.depth, 0.24 * p.depth)):
            radius = (0.13, 0.10)[(i + j) % 2] * min(p.width, p.depth)
            plate = cylinder((x, 0, z), "y", y - OVERLAP, y + 0.008, radius)
            dish = cylinder((x, 0, z), "y", y + 0.004, y + 0.02, 0.7 * radius)
            burners.append(subtract(plate, [dish]))
            burners.append(cylinder((x, 0, z), "y", y, y + 0.010, 0.4 * radius))
    return burners


def _door(p: OvenParameters, front: float, pivot: np.ndarray, roll: float, gap: float) -> Manifold:
    w, outer = p.width / 2 - gap, front + p.door_thickness
    low, high = p.plinth_height + gap, p.plinth_height + p.door_height - gap
    slab = rounded_box((-w, low, front + gap), (w, high, outer), "z", 0.008, 0.003)
    lower_edge = extrude(rounded_rectangle(2 * roll, 2 * roll, roll), "x", -w, w).translate((0.0, *pivot[1:]))
    profile = Manifold.batch_hull(
        [
            lower_edge,
            box((-w, low + roll, front + gap), (w, high, outer)),
            box((-w, low, front + gap), (w, high, pivot[2])),
        ]
    )
    middle = low + 0.46 * (high - low)
    u, v = p.window_width / 2, p.window_height / 2
    panes = [
        rounded_box((-u, middle - v, z0), (u, middle + v, z1), "z", p.window_corner)
        for z0, z1 in ((front, front + 0.35 * p.door_thickness), (outer - 0.3 * p.door_thickness, outer + 1e-3))
    ]
    handle_y = high - max(0.035, 0.09 * p.door_height)
    handle = bar_handle((0, handle_y, outer), "x", p.handle_length, p.handle_standoff, p.handle_radius, p.handle_square)
    return union([subtract(slab ^ profile, panes), handle])
