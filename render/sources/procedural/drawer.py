"""Chests of three drawers: a cabinet with three openings, and open boxes with fronts and handles that slide out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from manifold3d import Manifold

from render.sources.procedural.design import Design, slide
from render.sources.procedural.fittings import OVERLAP, bar_handle, feet
from render.sources.procedural.shapes import box, extrude, polygon, revolve, rounded_box, subtract, union

_NAMES = ("top_drawer", "middle_drawer", "bottom_drawer")
_SLIDE_NAMES = ("top_slide", "middle_slide", "bottom_slide")
_GAP = 0.003  # between a drawer and the cabinet, on every side


@dataclass(frozen=True)
class DrawerParameters:
    """Sizes in metres. Drawer heights run from top to bottom; `travel` is the way every drawer slides."""

    width: float
    depth: float
    drawer_heights: tuple[float, ...]
    panel: float
    rail: float
    inset_fronts: bool
    front_thickness: float
    front_edge: float
    box_wall: float
    box_height_share: float
    travel: float
    handle: str
    handle_length: float
    handle_radius: float
    handle_standoff: float
    handle_height_share: float
    two_handles: bool
    top_overhang: float
    top_thickness: float
    stand: str
    stand_height: float


def sample(rng: np.random.Generator) -> DrawerParameters:
    """Bedside tables, desk pedestals and chests of drawers."""
    width = rng.uniform(0.34, 0.95)
    depth = rng.uniform(0.36, 0.56)
    base_height = rng.uniform(0.12, 0.24)
    growth = rng.choice([0.0, 0.0, 0.03, 0.07])  # lower drawers may be deeper
    handle = str(rng.choice(["bar", "flat_bar", "knob", "cup", "cut_out"]))
    stand = str(rng.choice(["none", "plinth", "round_feet", "square_feet"], p=[0.15, 0.3, 0.3, 0.25]))
    return DrawerParameters(
        width=width,
        depth=depth,
        drawer_heights=tuple(base_height + growth * np.arange(3) * base_height / 0.12),
        panel=rng.uniform(0.015, 0.028),
        rail=rng.uniform(0.012, 0.022),
        inset_fronts=bool(rng.random() < 0.45),
        front_thickness=rng.uniform(0.015, 0.024),
        front_edge=rng.choice([0.0005, 0.003, 0.006]),
        box_wall=rng.uniform(0.009, 0.014),
        box_height_share=rng.uniform(0.6, 0.85),
        travel=depth * rng.uniform(0.6, 0.8),
        handle=handle,
        handle_length=rng.uniform(0.10, 0.20) if width < 0.6 else rng.uniform(0.12, 0.36),
        handle_radius=rng.uniform(0.005, 0.009),
        handle_standoff=rng.uniform(0.022, 0.035),
        handle_height_share=rng.uniform(0.5, 0.72),
        two_handles=bool(width > 0.6 and rng.random() < 0.7),
        top_overhang=rng.uniform(0.008, 0.025) if rng.random() < 0.5 else 0.0,
        top_thickness=rng.uniform(0.016, 0.035),
        stand=stand,
        stand_height=rng.uniform(0.03, 0.08) if stand == "plinth" else rng.uniform(0.05, 0.18),
    )


def build(p: DrawerParameters) -> Design:
    """Cabinet and closed drawers. All fronts lie in the plane z = depth / 2."""
    openings = _openings(p)
    parts = {"body": _body(p, openings)}
    for name, opening in zip(_NAMES, openings, strict=True):
        parts[name] = _drawer(p, *opening)
    joints = []
    for child, (low, high) in enumerate(openings, start=1):
        pivot = (0.0, (low + high) / 2, p.depth / 2)
        joints.append(slide(_SLIDE_NAMES[child - 1], child, (0.0, 0.0, 1.0), pivot, p.travel))
    return Design(parts, tuple(joints))


def _openings(p: DrawerParameters) -> list[tuple[float, float]]:
    """Lower and upper height of the three openings, top to bottom."""
    high = p.panel + sum(p.drawer_heights) + 2 * p.rail
    openings = []
    for height in p.drawer_heights:
        openings.append((high - height, high))
        high -= height + p.rail
    return openings


def _body(p: DrawerParameters, openings: list[tuple[float, float]]) -> Manifold:
    w, d = p.width / 2, p.depth / 2
    front = d if p.inset_fronts else d - p.front_thickness - _GAP
    top = openings[0][1]
    carcass = box((-w, 0, -d), (w, top + OVERLAP, front))
    cuts = [box((-w + p.panel, low, -d + p.panel), (w - p.panel, high, d + 0.01)) for low, high in openings]
    over = p.top_overhang
    plate = rounded_box(
        (-w - over, top, -d), (w + over, top + p.top_thickness, d + over), "y", 0.004 + 0.5 * over, 0.002
    )
    return union([subtract(carcass, cuts), plate, *_stand(p, front)])


def _stand(p: DrawerParameters, front: float) -> list[Manifold]:
    w, d = p.width / 2, p.depth / 2
    if p.stand == "none":
        return []
    if p.stand == "plinth":
        return [box((-w + 0.02, -p.stand_height, -d + 0.02), (w - 0.02, OVERLAP, front - 0.03))]
    return feet(w - 0.035, -d + 0.035, front - 0.035, 0.0, p.stand_height, 0.022, p.stand == "square_feet")


def _drawer(p: DrawerParameters, low: float, high: float) -> Manifold:
    w, d = p.width / 2, p.depth / 2
    inner, back = w - p.panel - _GAP, -d + p.panel + _GAP
    if p.inset_fronts:
        half, bottom, top = inner, low + _GAP, high - _GAP
    else:
        half, bottom = w - 0.001, low - p.rail / 2 + _GAP / 2
        top = min(high + p.rail / 2 - _GAP / 2, _openings(p)[0][1] - _GAP)  # below the table top
    front = rounded_box((-half, bottom, d - p.front_thickness), (half, top, d), "z", 0.002, p.front_edge)
    box_top = low + p.box_height_share * (high - low)
    shell = box((-inner, low + _GAP, back), (inner, box_top, d - p.front_thickness + OVERLAP))
    hollow = box(
        (-inner + p.box_wall, low + _GAP + p.box_wall, back + p.box_wall),
        (inner - p.box_wall, box_top + 1e-3, d - p.front_thickness - OVERLAP),
    )
    middle = bottom + p.handle_height_share * (top - bottom)
    return _with_handles(p, union([subtract(shell, [hollow]), front]), middle, top)


def _with_handles(p: DrawerParameters, solid: Manifold, y: float, top: float) -> Manifold:
    d = p.depth / 2
    if p.handle == "cut_out":
        half, reach = 0.3 * p.handle_length + 0.02, 0.028
        tool = rounded_box((-half, top - reach, d - 2 * p.front_thickness), (half, top + reach, d + 0.01), "z", 0.02)
        return subtract(solid, [tool])
    xs = (-0.24 * p.width, 0.24 * p.width) if p.two_handles else (0.0,)
    length = min(p.handle_length, (0.3 if p.two_handles else 0.5) * p.width)
    return union([solid, *(_handle(p, (x, y, d), length) for x in xs)])


def _handle(p: DrawerParameters, center: tuple[float, float, float], length: float) -> Manifold:
    if p.handle == "knob":
        return _mushroom(0.010 + 0.9 * p.handle_radius, p.handle_standoff).translate(center)
    if p.handle == "cup":
        return _cup(0.5 * min(length, 0.11), p.handle_standoff).translate(center)
    return bar_handle(center, "x", length, p.handle_standoff, p.handle_radius, square=p.handle == "flat_bar")


def _mushroom(radius: float, height: float) -> Manifold:
    """Round pull: a stem that widens to a flat head."""
    stem, head = 0.45 * radius, 0.62 * height
    profile = [(0, -OVERLAP), (0.7 * radius, -OVERLAP), (stem, 0.3 * height), (stem, 0.5 * height), (radius, head)]
    return revolve([*profile, (radius, 0.85 * height), (0.7 * radius, height), (0, height)], "z")


def _cup(half: float, height: float) -> Manifold:
    """Cup pull: a quarter shell that is open below."""
    wall, drop = 0.003, 1.1 * height
    outer = [(0.0, drop / 2), (height, -drop / 2 + 0.25 * drop), (height, -drop / 2), (-OVERLAP, -drop / 2)]
    shell = extrude(polygon([(-OVERLAP, drop / 2), *outer]), "x", -half, half)
    inner = [(0.0, drop / 2 - 1.5 * wall), (height - wall, -0.25 * drop - wall), (height - wall, -drop), (-0.01, -drop)]
    hollow = extrude(polygon([(-0.01, drop / 2 - 1.5 * wall), *inner]), "x", -half + wall, half - wall)
    return subtract(shell, [hollow])
