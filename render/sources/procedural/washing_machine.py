"""Front-loading washing machines: a body with drum, panel and knob, and a side-hinged door with a porthole."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from manifold3d import Manifold

from render.sources.procedural.design import Design, hinge
from render.sources.procedural.fittings import OVERLAP, feet, knob
from render.sources.procedural.shapes import (
    box,
    cylinder,
    extrude,
    polygon,
    revolve,
    rounded_box,
    subtract,
    union,
)

_SEGMENTS = 40  # of door and drum
_KNUCKLE_RADIUS = 0.007
_PIN_OFFSET = 0.016  # from the door's edge to the hinge line
_OPENING_DEPTH = 0.05  # from the front to the drum


@dataclass(frozen=True)
class WashingMachineParameters:
    """Sizes in metres. Heights are above the lower face of the body, the bowl depth is behind its front.

    A door is round, or a rounded square about its porthole if `square_door`.
    """

    width: float
    height: float
    depth: float
    corner: float
    panel_height: float
    panel_slope: float
    door_height: float
    door_radius: float
    door_thickness: float
    square_door: bool
    window_radius: float
    bowl_depth: float
    dish_depth: float
    grip_lug: bool
    drum_radius: float
    knob_x: float
    knob_radius: float
    knob_angle: float
    drawer_width: float
    drawer_proud: bool
    display: bool
    buttons: int
    hatch_round: bool
    plinth: bool
    foot_height: float


def sample(rng: np.random.Generator) -> WashingMachineParameters:
    """Full-size, slim and table-top machines."""
    width = rng.uniform(0.46, 0.74)
    height = width * rng.uniform(1.15, 1.75)
    panel_height = rng.uniform(0.09, 0.17)
    door_radius = rng.uniform(0.22, 0.39) * width
    free = height - panel_height
    window_radius = door_radius * rng.uniform(0.55, 0.80)
    drawer_left = rng.random() < 0.75
    return WashingMachineParameters(
        width=width,
        height=height,
        depth=rng.uniform(0.38, 0.80),
        corner=rng.uniform(0.003, 0.03),
        panel_height=panel_height,
        panel_slope=rng.uniform(0.15, 0.35) if rng.random() < 0.35 else 0.0,
        door_height=free * rng.uniform(0.46, 0.60) if free > 2.4 * door_radius else free / 2,
        door_radius=door_radius,
        door_thickness=rng.uniform(0.022, 0.065),
        square_door=bool(rng.random() < 0.2),
        window_radius=window_radius,
        bowl_depth=rng.uniform(0.0, 0.12),
        dish_depth=rng.uniform(0.004, 0.012),
        grip_lug=bool(rng.random() < 0.5),
        drum_radius=min(rng.uniform(1.15, 1.4) * window_radius, width / 2 - 0.03),
        knob_x=float(rng.choice([0.0, 0.08, 0.30])) * width,
        knob_radius=rng.uniform(0.022, 0.036),
        knob_angle=rng.uniform(-np.pi, np.pi),
        drawer_width=rng.uniform(0.22, 0.32) * width if drawer_left else 0.0,
        drawer_proud=bool(rng.random() < 0.5),
        display=bool(rng.random() < 0.6),
        buttons=int(rng.integers(0, 6)),
        hatch_round=bool(rng.random() < 0.4),
        plinth=bool(rng.random() < 0.3),
        foot_height=rng.uniform(0.012, 0.03),
    )


def build(p: WashingMachineParameters) -> Design:
    """Body and closed door, hinged on the left as front loaders are."""
    pivot = np.array([-p.door_radius - _PIN_OFFSET, p.door_height, p.depth / 2 + 0.5 * p.door_thickness])
    return Design(
        parts={"body": _body(p, pivot), "door": _door(p, pivot)},
        joints=(hinge("door_hinge", 1, (0.0, -1.0, 0.0), pivot, upper_deg=135.0),),
    )


def _body(p: WashingMachineParameters, pivot: np.ndarray) -> Manifold:
    w, front = p.width / 2, p.depth / 2
    center = (0.0, p.door_height, 0.0)
    opening = p.window_radius + 0.008
    cuts = [
        _door_outline(p, p.door_radius + 0.012, front - p.dish_depth, front + 1e-3),
        cylinder(center, "z", front - 2 * _OPENING_DEPTH, front, opening, segments=_SEGMENTS),
        cylinder(center, "z", -front + 0.06, front - _OPENING_DEPTH, p.drum_radius, segments=_SEGMENTS),
        *_grooves(p, front),
    ]
    carcass = rounded_box((-w, 0, -front), (w, p.height, front), "y", p.corner, 0.003)
    body = subtract(carcass, cuts)
    if p.panel_slope:
        low, run = p.height - p.panel_height, p.panel_height * p.panel_slope
        wedge = polygon([(front - run, p.height + 1e-3), (front + 1e-3, low), (front + 1e-3, p.height + 1e-3)])
        body = subtract(body, [extrude(wedge, "x", -p.width, p.width)])
    return union([body, *_panel(p, front), *_lifters(p, front), *_brackets(p, pivot, front), *_stand(p, front)])


def _door_outline(p: WashingMachineParameters, radius: float, low: float, high: float) -> Manifold:
    """Disc or rounded square of the door's shape, `radius` from its middle to its sides."""
    if not p.square_door:
        return cylinder((0.0, p.door_height, 0.0), "z", low, high, radius, segments=_SEGMENTS)
    corner = (-radius, p.door_height - radius, low), (radius, p.door_height + radius, high)
    return rounded_box(*corner, "z", 0.3 * radius)


def _grooves(p: WashingMachineParameters, front: float) -> list[Manifold]:
    """Joint line below the panel, and the outline of the filter hatch near the floor."""
    w, line = p.width / 2, p.height - p.panel_height
    grooves = [box((-w - 1e-3, line - 0.003, front - 0.003), (w + 1e-3, line, front + 1e-3))]
    x, y, r = 0.32 * p.width, 0.075 * p.height, 0.035
    if p.hatch_round:
        outline = [cylinder((x, y, 0), "z", front - 0.003, front + 1e-3, radius) for radius in (r, r - 0.004)]
    else:
        low, high = np.array([x - 1.6 * r, y - r, front - 0.003]), np.array([x + 1.6 * r, y + r, front + 1e-3])
        inset = np.array([0.004, 0.004, 0.0])
        outline = [rounded_box(low, high, "z", 0.006), rounded_box(low + inset, high - inset, "z", 0.004)]
    return [*grooves, subtract(outline[0], outline[1:])]


def _panel(p: WashingMachineParameters, front: float) -> list[Manifold]:
    """Knob, detergent drawer, display and buttons, on a panel that may lean back."""
    w, middle = p.width / 2, 0.5 * p.panel_height
    tilt = float(np.rad2deg(np.arctan(p.panel_slope)))
    solids = [knob((p.knob_x, middle, 0.0), min(p.knob_radius, 0.36 * p.panel_height), 0.028, p.knob_angle)]
    left = -0.92 * w
    if p.drawer_width:
        low, high = (left, 0.18 * p.panel_height), (left + p.drawer_width, 0.84 * p.panel_height)
        raised = 0.012 if p.drawer_proud else 0.004
        front_plate = rounded_box((*low, -0.01), (*high, raised), "z", 0.008, 0.002)
        grip = rounded_box(
            (low[0] + 0.02, low[1] - 0.01, raised - 0.003), (high[0] - 0.02, low[1] + 0.02, 0.1), "z", 0.004
        )
        solids.append(subtract(front_plate, [grip]))
    right = 0.92 * w
    clear = p.knob_x + p.knob_radius + 0.025
    if right - clear > 0.08:
        if p.display:
            size = min(0.11, right - clear)
            solids.append(rounded_box((clear, middle, -0.01), (clear + size, 0.82 * p.panel_height, 0.003), "z", 0.003))
        for x in np.linspace(clear + 0.01, right - 0.01, p.buttons):
            solids.append(cylinder((x, 0.26 * p.panel_height, 0), "z", -0.01, 0.005, 0.007, segments=12))
    origin = (0.0, p.height - p.panel_height, front)
    return [solid.rotate((-tilt, 0.0, 0.0)).translate(origin) for solid in solids]


def _lifters(p: WashingMachineParameters, front: float) -> list[Manifold]:
    low, high = -front + 0.06 - OVERLAP, front - _OPENING_DEPTH + OVERLAP
    ridge = polygon([(-0.035, -p.drum_radius - 0.004), (0.035, -p.drum_radius - 0.004), (0.0, -0.72 * p.drum_radius)])
    return [extrude(ridge, "z", low, high).rotate((0, 0, a)).translate((0, p.door_height, 0)) for a in (60, 180, 300)]


def _brackets(p: WashingMachineParameters, pivot: np.ndarray, front: float) -> list[Manifold]:
    """Two knuckles on the body, above and below the door's own."""
    x, y, z = pivot
    solids = []
    for low, high in ((y + 0.031, y + 0.052), (y - 0.052, y - 0.031)):
        solids.append(cylinder(pivot, "y", low, high, _KNUCKLE_RADIUS, segments=16))
        solids.append(box((x - 0.006, low, front - 0.02), (x + 0.006, high, z)))
    return solids


def _stand(p: WashingMachineParameters, front: float) -> list[Manifold]:
    if p.plinth:
        w = p.width / 2 - 0.02
        return [box((-w, -p.foot_height, -front + 0.02), (w, OVERLAP + 0.003, front - 0.03))]
    return feet(p.width / 2 - 0.06, -front + 0.06, front - 0.06, 0.004, p.foot_height, 0.02, square=False)


def _door(p: WashingMachineParameters, pivot: np.ndarray) -> Manifold:
    front, t, window, gap = p.depth / 2, p.door_thickness, p.window_radius, 0.002
    glass, bevel = 0.007, 0.25 * t
    # Glass bowl behind the rim, from the middle outwards; its depth grows with the third power inwards.
    r = np.linspace(0.0, window, 9)
    z = -p.bowl_depth + (p.bowl_depth + 0.45 * t) * (r / window) ** 3
    outside = [*zip(r, z, strict=True), (window, t), (p.door_radius - bevel, t), (p.door_radius, t - bevel)]
    inside = [(p.door_radius, gap), (window, gap), *zip(r[-2::-1], z[-2::-1] - glass, strict=True)]
    porthole = revolve([*outside, *inside], "z", _SEGMENTS).translate((0, p.door_height, front))
    if p.square_door:
        rim = _door_outline(p, p.door_radius, front + gap, front + 0.7 * t)
        hole = cylinder((0.0, p.door_height, 0.0), "z", front - 1.0, front + 1.0, 0.99 * window, segments=_SEGMENTS)
        porthole = union([porthole, subtract(rim, [hole])])
    x, y, z0 = pivot
    lug = box((x, y - 0.03, z0 - 0.006), (-p.door_radius + 0.02, y + 0.03, z0 + 0.006))
    knuckle = cylinder(pivot, "y", y - 0.03, y + 0.03, _KNUCKLE_RADIUS, segments=16)
    edge = p.door_radius
    if p.grip_lug:
        grip = rounded_box(
            (edge - 0.03, y - 0.045, front + gap), (edge + 0.022, y + 0.045, front + 0.8 * t), "z", 0.012, 0.003
        )
        return union([porthole, lug, knuckle, grip])
    recess = rounded_box(
        (edge - 0.03, y - 0.05, front + t - 0.012), (edge - 0.012, y + 0.05, front + 2 * t), "z", 0.008
    )
    return subtract(union([porthole, lug, knuckle]), [recess])
