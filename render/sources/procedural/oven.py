"""Ovens: a body with cavity, racks and control panel, and a door with window and handle, hinged below or at a side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from manifold3d import Manifold

from render.sources.procedural.design import Design, from_quantiles, hinge
from render.sources.procedural.fittings import OVERLAP, bar_handle, feet, knob
from render.sources.procedural.shapes import (
    box,
    cylinder,
    extrude,
    intersect,
    rounded_box,
    rounded_rectangle,
    subtract,
    union,
)

_GAP = 0.002  # between door and body
_COLUMN_MARGIN = 0.004  # between a narrow door and the column beside it

# Share of the height of the body's box, feet and backguard included, that the door takes, by kind: together they span
# 9 CAD ovens (.49 to .82 with a median of .56; findings of 2026-11-21, section 1), as do the hinge heights below.
_DOOR_SHARE = {
    "range": (0.49, 0.52, 0.55, 0.58, 0.64),
    "built_in": (0.54, 0.60, 0.66, 0.74, 0.82),
    "counter_top": (0.54, 0.60, 0.66, 0.74, 0.82),
}
_HINGE_SHARE = {"range": (0.08, 0.16, 0.29), "built_in": (0.008, 0.03, 0.06), "counter_top": (0.02, 0.06, 0.12)}
_LEAST_PANEL = 0.05  # of the height, for what lies above the door
_SIDE_HINGED = 1 / 9
_NARROW_DOOR = 0.11  # share of ovens whose controls stand in a column beside the door


@dataclass(frozen=True)
class OvenParameters:
    """Sizes in metres. The front, from top to bottom: control panel, door, plinth (which may be a storage drawer).

    Attributes:
        hinge_side: `bottom`, `left` or `right`.
        column_width: Of the controls beside a narrow door; 0 for a door as wide as the body.
        drawer_pull: Length of the handle of the storage drawer; 0 if it has none.
        niche: Whether the space below the door is an open shelf.
        louvres: Slots in the back.
        rails: Ledges on either side of the cavity.
        hob: `none`, `plates` or `grates`.
    """

    width: float
    depth: float
    panel_height: float
    door_height: float
    plinth_height: float
    door_thickness: float
    hinge_side: str
    column_width: float
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
    hob: str
    backguard_height: float
    racks: int
    rack_wires: int
    drawer_groove: bool
    drawer_pull: float
    niche: bool
    louvres: int
    rails: int
    foot_height: float
    foot_radius: float
    foot_square: bool

    @property
    def door_width(self) -> float:
        """Of the door and its play."""
        return self.width - self.column_width

    @property
    def door_middle(self) -> float:
        """x of the middle of the door; the column is on the side away from the hinge."""
        return (0.5 if self.hinge_side == "right" else -0.5) * self.column_width


def sample(rng: np.random.Generator) -> OvenParameters:
    """Free-standing ranges, built-in ovens and small counter-top ovens."""
    kind = str(rng.choice(["range", "built_in", "counter_top"], p=[0.62, 0.2, 0.18]))
    width, height, depth = _draw_body(rng, kind)
    door_share, hinge_share = from_quantiles(rng, *_DOOR_SHARE[kind]), from_quantiles(rng, *_HINGE_SHARE[kind])
    hinge_share = min(hinge_share, 1 - _LEAST_PANEL - door_share)
    above = height * (1 - door_share - hinge_share)
    panel, backguard = _draw_above(rng, kind, above)
    foot = height * hinge_share * rng.uniform(0.1, 0.5)
    side = str(rng.choice(["left", "right"], p=[0.8, 0.2])) if rng.random() < _SIDE_HINGED else "bottom"
    column = width * rng.uniform(0.15, 0.49) if rng.random() < _NARROW_DOOR else 0.0
    # The way from the hinge to the handle, and along the hinge.
    across, along = (height * door_share, width - column)[:: 1 if side == "bottom" else -1]
    knobs = int(rng.integers(2, 7 if kind == "range" else 4))
    plinth = height * hinge_share - foot
    niche = plinth > 0.11 and rng.random() < 0.35
    pulled = plinth > 0.11 and not niche and rng.random() < 0.5
    return OvenParameters(
        width=width,
        depth=depth,
        panel_height=panel,
        door_height=height * door_share,
        plinth_height=plinth,
        door_thickness=rng.uniform(0.022, 0.06) if kind != "counter_top" else rng.uniform(0.012, 0.03),
        hinge_side=side,
        column_width=column,
        corner=rng.uniform(0.0, 0.02),
        wall=min(rng.uniform(0.018, 0.055), 0.15 * min(width - column, height * door_share)),
        window_width=along * rng.uniform(0.4, 0.8),
        window_height=across * rng.uniform(0.34, 0.62) if rng.random() < 0.9 else 0.0,
        window_corner=rng.choice([0.004, 0.02, 0.05]),
        handle_length=along * rng.uniform(0.3, 0.9),
        handle_radius=rng.uniform(0.006, 0.014),
        handle_standoff=rng.uniform(0.025, 0.055),
        handle_square=bool(rng.random() < 0.4),
        knobs=knobs,
        knob_radius=min(rng.uniform(0.012, 0.026), 0.3 * max(panel, 0.6 * column)),
        knob_angles=tuple(rng.uniform(-1.0, 1.0, knobs)),
        display=bool(rng.random() < 0.5 and panel > 0.06),
        hob=str(rng.choice(["none", "plates", "grates"], p=[0.3, 0.4, 0.3])) if kind == "range" else "none",
        backguard_height=backguard,
        racks=int(rng.integers(0, 4)),
        rack_wires=int(rng.integers(5, 8)),
        drawer_groove=bool(plinth > 0.06 and not niche and (pulled or rng.random() < 0.6)),
        niche=niche,
        louvres=int(rng.integers(8, 20)) if rng.random() < 0.75 else 0,
        rails=int(rng.integers(3, 8)) if rng.random() < 0.8 else 0,
        drawer_pull=width * rng.uniform(0.2, 0.7) if pulled else 0.0,
        foot_height=foot,
        foot_radius=rng.uniform(0.016, 0.028),
        foot_square=bool(rng.random() < 0.4),
    )


def _draw_body(rng: np.random.Generator, kind: str) -> tuple[float, float, float]:
    """Width, height and depth of the body."""
    if kind == "range":
        return rng.uniform(0.48, 0.92), rng.uniform(0.82, 1.18), rng.uniform(0.50, 0.68)
    if kind == "built_in":
        return rng.uniform(0.55, 0.76), rng.uniform(0.42, 0.72), rng.uniform(0.48, 0.60)
    return rng.uniform(0.36, 0.56), rng.uniform(0.22, 0.40), rng.uniform(0.28, 0.44)


def _draw_above(rng: np.random.Generator, kind: str, above: float) -> tuple[float, float]:
    """Heights of control panel and backguard, which share what lies above the door."""
    if kind != "range" or above < 0.14 or rng.random() < 0.25:
        return above, 0.0
    panel = min(rng.uniform(0.06, 0.15), 0.7 * above)
    return panel, above - panel


def build(p: OvenParameters) -> Design:
    """Body and closed door. The hinge runs inside the edge of the door that it is at, which is rounded about it."""
    front = p.depth / 2
    roll = 0.2 * p.door_thickness
    hinge_z = front + p.door_thickness - roll
    door, axis = _door(p, front, hinge_z, roll), np.array([1.0, 0.0, 0.0])
    pivot = np.array([p.door_middle, p.plinth_height + _GAP + roll, hinge_z])
    door_low = np.array([p.door_middle, p.plinth_height, 0.0])
    if p.hinge_side != "bottom":  # made standing on its hinge, then laid on its side
        door, axis = door.rotate((0.0, 0.0, -90.0)), np.array([0.0, -1.0, 0.0])
        middle = p.plinth_height + p.door_height / 2
        edge = p.door_middle - p.door_width / 2
        pivot, door_low = np.array([edge + _GAP + roll, middle, hinge_z]), np.array([edge, middle, 0.0])
    if p.hinge_side == "right":
        door, axis = door.mirror((1.0, 0.0, 0.0)), -axis
        edge = p.door_middle + p.door_width / 2
        pivot[0], door_low[0] = edge - _GAP - roll, edge
    return Design(
        parts={"body": _body(p, front, hinge_z - roll - _GAP), "door": door.translate(tuple(door_low))},
        joints=(hinge("door_hinge", 1, axis, pivot, upper_deg=135.0),),
    )


def _body(p: OvenParameters, front: float, plinth_front: float) -> Manifold:
    """`plinth_front` leaves room for the door's lower edge, which turns over it."""
    w, t = p.width / 2, p.door_thickness
    door_top = p.plinth_height + p.door_height
    height = door_top + p.panel_height
    middle, half = p.door_middle, p.door_width / 2 - p.wall
    carcass = rounded_box((-w, 0, -front), (w, height, front), "z", p.corner)
    panel = rounded_box((-w, door_top, front - OVERLAP), (w, height, front + t), "z", p.corner, 0.003)
    edge = 0.2 * min(0.015, p.plinth_height, plinth_front - front)
    plinth = rounded_box((-w, 0, front - OVERLAP), (w, p.plinth_height, plinth_front), "z", min(p.corner, 0.01), edge)
    cavity = rounded_box(
        (middle - half, p.plinth_height + p.wall, -front + p.wall),
        (middle + half, door_top - p.wall, front + 1e-3),
        "z",
        0.015,
    )
    cuts = [cavity]
    if p.niche:
        low, high = (-w + 0.03, 0.02, -front + 0.03), (w - 0.03, p.plinth_height - 0.03, plinth_front + 1e-3)
        cuts.append(box(low, high))
    if p.louvres:
        deep, ys = -front + 0.8 * p.wall, np.linspace(0.2 * height, 0.9 * height, 2 * p.louvres)
        pairs = zip(ys[::2], ys[1::2], strict=True)
        cuts += [box((-0.42 * p.width, low, -front - 1e-3), (0.42 * p.width, high, deep)) for low, high in pairs]
    if p.drawer_groove:
        y = 0.86 * p.plinth_height
        cuts.append(box((-w - 1e-3, y, plinth_front - 0.012), (w + 1e-3, y + 0.008, plinth_front + 1e-3)))
    if p.display:
        cuts.append(_panel_display(p, door_top, front + t))
    blocks = [carcass, panel, plinth]
    if p.column_width:
        blocks.append(_column(p, front, door_top))
    solids = [subtract(union(blocks), cuts), *_rack_bars(p, front), *_controls(p, door_top, front + t)]
    solids += feet(w - 0.06, -front + 0.06, front - 0.04, 0.0, p.foot_height, p.foot_radius, p.foot_square)
    if p.drawer_pull:
        pull = (0.0, 0.45 * p.plinth_height, plinth_front)
        solids.append(bar_handle(pull, "x", p.drawer_pull, 0.022, 0.006, p.handle_square))
    if p.hob != "none":
        solids += _burners(p, height) if p.hob == "plates" else _grates(p, height)
    if p.backguard_height:
        solids.append(
            rounded_box((-w, height - OVERLAP, -front), (w, height + p.backguard_height, -front + 0.05), "z", 0.01)
        )
    return union(solids)


def _column(p: OvenParameters, front: float, door_top: float) -> Manifold:
    """Front beside a narrow door, flush with it."""
    inner, outer = p.door_width / 2 + p.door_middle + _COLUMN_MARGIN, p.width / 2
    if p.hinge_side == "right":
        inner, outer = -p.width / 2, -p.door_width / 2 + p.door_middle - _COLUMN_MARGIN
    low, high = (inner, p.plinth_height + _GAP, front - OVERLAP), (outer, door_top + OVERLAP, front + p.door_thickness)
    return rounded_box(low, high, "z", 0.002, 0.002)


def _panel_display(p: OvenParameters, door_top: float, z: float) -> Manifold:
    half, middle = 0.09 * p.width, door_top + p.panel_height / 2
    return rounded_box((-half, middle - 0.02, z - 0.003), (half, middle + 0.02, z + 1e-3), "z", 0.004)


def _controls(p: OvenParameters, door_top: float, z: float) -> list[Manifold]:
    """Knobs side by side above the door, or above each other in the column beside it."""
    if p.column_width:
        x = (0.5 * p.width - 0.5 * p.column_width) * (-1 if p.hinge_side == "right" else 1)
        ys = p.plinth_height + p.door_height * np.linspace(0.14, 0.86, p.knobs)
        radius = min(p.knob_radius, 0.36 * p.door_height / p.knobs)
        return [knob((x, y, z), radius, 1.1 * radius, angle) for y, angle in zip(ys, p.knob_angles, strict=True)]
    y, span = door_top + min(p.panel_height / 2, 0.08), 0.40 * p.width
    xs = np.linspace(-span, span, p.knobs)
    if p.display:  # it takes the middle of the panel
        left, inner = (p.knobs + 1) // 2, 0.16 * p.width
        xs = [*np.linspace(-span, -inner, left), *np.linspace(inner, span, p.knobs - left)]
    return [
        knob((x, y, z), p.knob_radius, 1.1 * p.knob_radius, angle) for x, angle in zip(xs, p.knob_angles, strict=True)
    ]


def _rack_bars(p: OvenParameters, front: float) -> list[Manifold]:
    x, back, near = p.door_width / 2 - p.wall + 0.002, -front + p.wall - 0.002, front - 0.02
    low, high = p.plinth_height + p.wall, p.plinth_height + p.door_height - p.wall
    bar = 0.004
    bars = _rails(p, x, low, high, back, near)
    for y in np.linspace(low, high, p.racks + 2)[1:-1]:
        for z in np.linspace(back + 0.02, near, 3):
            bars.append(box((-x, y - bar, z - bar), (x, y + bar, z + bar)))
        for u in np.linspace(-0.88 * x, 0.88 * x, p.rack_wires):
            bars.append(box((u - 0.75 * bar, y - 0.75 * bar, back), (u + 0.75 * bar, y + 0.75 * bar, near)))
    return [solid.translate((p.door_middle, 0.0, 0.0)) for solid in bars]


def _rails(p: OvenParameters, x: float, low: float, high: float, back: float, near: float) -> list[Manifold]:
    """Ledges on the side walls at ±`x`, a little off the heights of the racks."""
    reach = min(0.02, 0.1 * x)
    return [
        box((min(side * x, side * (x - reach)), y, back), (max(side * x, side * (x - reach)), y + 0.004, near))
        for y in np.linspace(low + 0.012, high - 0.016, p.rails)
        for side in (-1, 1)
    ]


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


def _grates(p: OvenParameters, y: float) -> list[Manifold]:
    """Gas burners under bars that cross the hob."""
    high, bar, solids = y + 0.035, 0.005, []
    reach_x, reach_z = 0.42 * p.width, 0.36 * p.depth
    for x in np.linspace(-reach_x, reach_x, 5):
        solids.append(box((x - bar, high - 2 * bar, -reach_z), (x + bar, high, reach_z)))
    for z in (-reach_z, 0.0, reach_z):
        solids.append(box((-reach_x - bar, high - 2 * bar, z - bar), (reach_x + bar, high, z + bar)))
        for x in (-reach_x, reach_x):
            solids.append(box((x - bar, y - OVERLAP, z - bar), (x + bar, high - bar, z + bar)))
    for x in (-0.21 * p.width, 0.21 * p.width):
        for z in (-0.18 * p.depth, 0.18 * p.depth):
            solids.append(cylinder((x, 0, z), "y", y - OVERLAP, y + 0.018, 0.035, 0.028))
    return solids


def _door(p: OvenParameters, front: float, hinge_z: float, roll: float) -> Manifold:
    """The door above its hinge, centred on x = 0, its lower edge with the gap below it on y = 0."""
    across, along = (p.door_height, p.door_width)[:: 1 if p.hinge_side == "bottom" else -1]
    w, outer = along / 2 - _GAP, front + p.door_thickness
    # The inner corner of the free edge rises before it comes forward.
    low, high = _GAP, across - _GAP - (np.hypot(across, p.door_thickness) - across)
    slab = rounded_box((-w, low, front + _GAP), (w, high, outer), "z", 0.008, 0.003)
    lower_edge = extrude(rounded_rectangle(2 * roll, 2 * roll, roll), "x", -w, w)
    profile = Manifold.batch_hull(
        [
            lower_edge.translate((0.0, low + roll, hinge_z)),
            box((-w, low + roll, front + _GAP), (w, high, outer)),
            box((-w, low, front + _GAP), (w, high, hinge_z)),
        ]
    )
    cuts, middle = [], low + 0.46 * (high - low)
    u, v = p.window_width / 2, p.window_height / 2
    if v > 0:
        faces = ((front, front + 0.35 * p.door_thickness), (outer - 0.3 * p.door_thickness, outer + 1e-3))
        cuts = [
            rounded_box((-u, middle - v, z0), (u, middle + v, z1), "z", min(p.window_corner, 0.4 * v))
            for z0, z1 in faces
        ]
    handle_y = high - max(0.02, 0.08 * across)
    handle = bar_handle((0, handle_y, outer), "x", p.handle_length, p.handle_standoff, p.handle_radius, p.handle_square)
    return union([subtract(intersect(slab, profile), cuts), handle])
