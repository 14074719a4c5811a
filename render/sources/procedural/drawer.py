"""Chests and desks with three drawers: cases with three openings, and open boxes with fronts that slide out of them."""

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
class Opening:
    """Hole of one drawer in the front: low and high (x, y), and how far an overlay front reaches beyond (metres)."""

    low: tuple[float, float]
    high: tuple[float, float]
    reach_low: tuple[float, float]
    reach_high: tuple[float, float]


@dataclass(frozen=True)
class DrawerParameters:
    """Sizes in metres; y = 0 is the lower face of the lowest case.

    `layout` is `stack` for chests, `row` for desks with three drawers side by side, `pedestal` for desks with two
    drawers on one side and one across. Drawer heights and widths are those of the openings, from top to bottom and from
    left to right; `travel` is the way every drawer slides. `case_depth` is that of the cases, `depth` of the table top.
    """

    layout: str
    width: float
    depth: float
    case_depth: float
    drawer_heights: tuple[float, ...]
    drawer_widths: tuple[float, ...]
    mirrored: bool
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
    back_panel: float


def sample(rng: np.random.Generator) -> DrawerParameters:
    """Bedside tables, desk pedestals and chests of drawers; one in four is a desk."""
    layout = str(rng.choice(["stack", "row", "pedestal"], p=[0.74, 0.12, 0.14]))
    desk = layout != "stack"
    width = rng.uniform(0.9, 1.6) if desk else rng.uniform(0.30, 1.10)
    depth = rng.uniform(0.45, 0.70) if desk else rng.uniform(0.32, 0.58)
    case_depth = depth * rng.uniform(0.7, 1.0) if desk else depth
    handle = str(rng.choice(["bar", "flat_bar", "knob", "cup", "cut_out", "none"]))
    stand = str(rng.choice(["none", "plinth", "round_feet", "square_feet"], p=[0.15, 0.3, 0.3, 0.25]))
    if layout == "row":
        stand = str(rng.choice(["round_feet", "square_feet", "sides"]))
    return DrawerParameters(
        layout=layout,
        width=width,
        depth=depth,
        case_depth=case_depth,
        drawer_heights=_draw_heights(rng, layout),
        drawer_widths=_draw_widths(rng, layout, width),
        mirrored=bool(layout == "pedestal" and rng.random() < 0.5),
        panel=rng.uniform(0.015, 0.028),
        rail=rng.uniform(0.012, 0.022),
        inset_fronts=bool(rng.random() < 0.45),
        front_thickness=rng.uniform(0.015, 0.024),
        front_edge=rng.choice([0.0005, 0.003, 0.006]),
        box_wall=rng.uniform(0.009, 0.014),
        box_height_share=rng.uniform(0.6, 0.85),
        travel=case_depth * rng.uniform(0.55, 0.85),
        handle=handle,
        handle_length=rng.uniform(0.10, 0.20) if width < 0.6 or desk else rng.uniform(0.12, 0.36),
        handle_radius=rng.uniform(0.005, 0.009),
        handle_standoff=rng.uniform(0.022, 0.035),
        handle_height_share=rng.uniform(0.5, 0.72),
        two_handles=bool(width > 0.6 and not desk and rng.random() < 0.6),
        top_overhang=rng.uniform(0.008, 0.03) if rng.random() < 0.5 else 0.0,
        top_thickness=rng.uniform(0.016, 0.04),
        stand=stand,
        stand_height=_draw_stand_height(rng, layout, stand),
        back_panel=rng.uniform(0.1, 0.4) if desk and rng.random() < 0.5 else 0.0,
    )


def _draw_heights(rng: np.random.Generator, layout: str) -> tuple[float, ...]:
    """From top to bottom: alike, growing downwards, or as it comes; the two of a pedestal differ."""
    if layout == "row":
        return (rng.uniform(0.07, 0.16),)
    if layout == "pedestal":
        return rng.uniform(0.08, 0.16), rng.uniform(0.20, 0.45)
    base, kind = rng.uniform(0.10, 0.24), rng.random()
    if kind < 0.35:
        return (base,) * 3
    if kind < 0.7:
        return tuple(base * rng.uniform(0.8, 1.0) * (1 + rng.uniform(0.1, 0.6) * np.arange(3)))
    return tuple(base * rng.uniform(0.5, 1.6, 3))


def _draw_widths(rng: np.random.Generator, layout: str, width: float) -> tuple[float, ...]:
    """Of the openings of a desk, as far as they are free: sides of a row, or of the pedestal."""
    if layout == "row":
        return (width * rng.uniform(0.2, 0.32),)
    return (rng.uniform(0.28, 0.42),)


def _draw_stand_height(rng: np.random.Generator, layout: str, stand: str) -> float:
    if layout == "row":
        return rng.uniform(0.50, 0.68)
    if stand == "plinth":
        return rng.uniform(0.03, 0.10)
    return rng.uniform(0.05, 0.18) if layout == "pedestal" or rng.random() < 0.8 else rng.uniform(0.18, 0.40)


def build(p: DrawerParameters) -> Design:
    """Cabinet and closed drawers. All fronts lie in the plane z = depth / 2."""
    openings = _OPENINGS[p.layout](p)
    if p.mirrored:
        openings = [_mirrored(opening) for opening in openings]
    parts = {"body": _body(p, openings)}
    for name, opening in zip(_NAMES, openings, strict=True):
        parts[name] = _drawer(p, opening)
    joints = []
    for child, opening in enumerate(openings, start=1):
        x, y = (np.array(opening.low) + opening.high) / 2
        joints.append(slide(_SLIDE_NAMES[child - 1], child, (0.0, 0.0, 1.0), (x, y, p.depth / 2), p.travel))
    return Design(parts, tuple(joints))


def _stack(p: DrawerParameters) -> list[Opening]:
    """Three drawers above each other, top to bottom."""
    half, side = p.width / 2 - p.panel, p.panel - 0.001
    high, openings = p.panel + sum(p.drawer_heights) + 2 * p.rail, []
    for height in p.drawer_heights:
        openings.append(_opening(p, -half, half, high - height, high, side, side))
        high -= height + p.rail
    return openings


def _row(p: DrawerParameters) -> list[Opening]:
    """Three drawers side by side, left to right."""
    half, side, middle = p.width / 2 - p.panel, p.panel - 0.001, 0.5 * (p.rail - _GAP)
    (outer,), (height,) = p.drawer_widths, p.drawer_heights
    low, high = p.panel, p.panel + height
    inner = half - outer - p.rail
    return [
        _opening(p, -half, -half + outer, low, high, side, middle),
        _opening(p, -inner, inner, low, high, middle, middle),
        _opening(p, half - outer, half, low, high, middle, side),
    ]


def _pedestal(p: DrawerParameters) -> list[Opening]:
    """Two drawers above each other on the right, one across on the left, beside the upper one."""
    half, side, middle = p.width / 2 - p.panel, p.panel - 0.001, 0.5 * (p.panel - _GAP)
    (pedestal,), (upper, lower) = p.drawer_widths, p.drawer_heights
    top = 2 * p.panel + lower + upper
    left = half - pedestal
    return [
        _opening(p, -half, left - p.panel, top - upper, top, side, middle),
        _opening(p, left, half, top - upper, top, middle, side),
        _opening(p, left, half, p.panel, p.panel + lower, middle, side),
    ]


_OPENINGS = {"stack": _stack, "row": _row, "pedestal": _pedestal}


def _opening(
    p: DrawerParameters, x0: float, x1: float, y0: float, y1: float, reach_left: float, reach_right: float
) -> Opening:
    above = 0.5 * (p.rail - _GAP)
    return Opening((x0, y0), (x1, y1), (reach_left, above), (reach_right, above))


def _mirrored(opening: Opening) -> Opening:
    return Opening(
        low=(-opening.high[0], opening.low[1]),
        high=(-opening.low[0], opening.high[1]),
        reach_low=(opening.reach_high[0], opening.reach_low[1]),
        reach_high=(opening.reach_low[0], opening.reach_high[1]),
    )


def _top(openings: list[Opening]) -> float:
    """Height of the lower face of the table top."""
    return max(opening.high[1] for opening in openings)


def _body(p: DrawerParameters, openings: list[Opening]) -> Manifold:
    w, d = p.width / 2, p.depth / 2
    front, back = d if p.inset_fronts else d - p.front_thickness - _GAP, d - p.case_depth
    top, over = _top(openings), p.top_overhang
    cases = [
        box((low[0] - p.panel, low[1] - p.panel, back), (high[0] + p.panel, top + OVERLAP, front))
        for low, high in ((opening.low, opening.high) for opening in openings)
    ]
    cuts = [
        box((opening.low[0], opening.low[1], back + p.panel), (opening.high[0], opening.high[1], d + 0.01))
        for opening in openings
    ]
    plate = rounded_box(
        (-w - over, top, -d), (w + over, top + p.top_thickness, d + over), "y", 0.004 + 0.5 * over, 0.002
    )
    return union([subtract(union(cases), cuts), plate, *_stand(p, openings, front, back)])


def _stand(p: DrawerParameters, openings: list[Opening], front: float, back: float) -> list[Manifold]:
    """What the lowest case stands on, and what carries a desk where there is none."""
    lowest = min(openings, key=lambda opening: opening.low[1])
    x0, x1 = lowest.low[0] - p.panel, lowest.high[0] + p.panel
    floor = -p.stand_height if p.stand != "none" else 0.0
    if p.layout == "row":
        return _table_legs(p, floor, OVERLAP, (-p.width / 2, p.width / 2), back, front)
    solids = _low_stand(p, x0, x1, front, back)
    if p.layout == "pedestal":
        far = -p.width / 2 if x0 > -p.width / 2 + 0.01 else p.width / 2
        solids += _table_legs(p, floor, _top(openings) - p.drawer_heights[0], (far,), back, front)
        if p.back_panel:
            solids.append(
                box((-p.width / 2, _top(openings) - p.back_panel, back), (p.width / 2, _top(openings), back + 0.012))
            )
    return solids


def _low_stand(p: DrawerParameters, x0: float, x1: float, front: float, back: float) -> list[Manifold]:
    if p.stand == "none":
        return []
    if p.stand == "plinth":
        return [box((x0 + 0.02, -p.stand_height, back + 0.02), (x1 - 0.02, OVERLAP, front - 0.03))]
    half, middle = (x1 - x0) / 2, (x0 + x1) / 2
    legs = feet(half - 0.035, back + 0.035, front - 0.035, 0.0, p.stand_height, 0.022, p.stand == "square_feet")
    return [leg.translate((middle, 0.0, 0.0)) for leg in legs]


def _table_legs(
    p: DrawerParameters, floor: float, top: float, sides: tuple[float, ...], back: float, front: float
) -> list[Manifold]:
    """Two legs, or a side panel, at every given end of a desk, up to `top`."""
    legs, thick = [], 0.045
    for x in sides:
        inner = x - np.sign(x) * (p.panel if p.stand in ("sides", "plinth") else thick)
        low, high = min(x, inner), max(x, inner)
        if p.stand in ("sides", "plinth"):
            legs.append(box((low, floor, back), (high, top, front)))
        else:
            legs += [box((low, floor, z), (high, top, z + thick)) for z in (back, front - thick)]
    return legs


def _drawer(p: DrawerParameters, opening: Opening) -> Manifold:
    d = p.depth / 2
    back = d - p.case_depth + p.panel + _GAP
    low, high = np.array(opening.low) + _GAP, np.array(opening.high) - _GAP
    face_low, face_high = low.copy(), high.copy()
    if not p.inset_fronts:
        face_low, face_high = np.array(opening.low) - opening.reach_low, np.array(opening.high) + opening.reach_high
        if opening.high[1] >= _top(_OPENINGS[p.layout](p)) - 1e-9:
            face_high[1] = high[1]  # below the table top
    front = rounded_box((*face_low, d - p.front_thickness), (*face_high, d), "z", 0.002, p.front_edge)
    box_top = opening.low[1] + p.box_height_share * (opening.high[1] - opening.low[1])
    wall = p.box_wall
    shell = box((*low, back), (high[0], box_top, d - p.front_thickness + OVERLAP))
    hollow = box(
        (low[0] + wall, low[1] + wall, back + wall),
        (high[0] - wall, box_top + 1e-3, d - p.front_thickness - OVERLAP),
    )
    return _with_handles(p, union([subtract(shell, [hollow]), front]), face_low, face_high)


def _with_handles(p: DrawerParameters, solid: Manifold, low: np.ndarray, high: np.ndarray) -> Manifold:
    """The drawer with what it is pulled by, on a front from `low` to `high` (x, y)."""
    d, (width, height), middle = p.depth / 2, high - low, (low[0] + high[0]) / 2
    if p.handle == "none":
        return solid
    if p.handle == "cut_out":
        half, reach = min(0.3 * p.handle_length + 0.02, 0.35 * width), min(0.028, 0.3 * height)
        tool = rounded_box(
            (middle - half, high[1] - reach, d - 2 * p.front_thickness),
            (middle + half, high[1] + reach, d + 0.01),
            "z",
            0.02,
        )
        return subtract(solid, [tool])
    y = low[1] + p.handle_height_share * height
    xs = (middle - 0.24 * width, middle + 0.24 * width) if p.two_handles else (middle,)
    length = min(p.handle_length, (0.3 if p.two_handles else 0.5) * width)
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
