"""Laptops: base and lid from their parameters; the base makes room for whatever of the lid swings behind its hinge."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from manifold3d import CrossSection, Manifold, OpType

from render.sources.procedural.design import Design, hinge
from render.sources.procedural.laptop_parameters import PLAY, LaptopParameters
from render.sources.procedural.shapes import (
    box,
    cylinder,
    extrude,
    intersect,
    polygon,
    rounded_box,
    rounded_rectangle,
    subtract,
    union,
)

_TAPER_START = -0.3  # where the underside starts to rise, in depths from the middle
_CLEARANCE = 0.0003  # around everything that swings; less than the gap between the closed plates
_SWEEP_TOLERANCE = 5e-5  # of the outline of what a lid sweeps
_SWEEP_STEP_DEG = 4.0  # leaves ridges of 0.06 % of the radius, far less than the clearance


def build(p: LaptopParameters) -> Design:
    """Base and lid, closed."""
    pivot = np.array([0.0, p.pivot[0], -p.depth / 2 + p.pivot[1]])
    return Design(
        parts={"base": _base(p, pivot), "lid": _lid(p, pivot)},
        joints=(hinge("lid_hinge", 1, (-1.0, 0.0, 0.0), pivot, upper_deg=p.opening),),
    )


def _panel_profile(p: LaptopParameters, pivot: np.ndarray, front: float) -> CrossSection:
    """Section (z, y) of the lid's panel from its rear edge to `front`."""
    low = p.slab + p.gap
    return _rectangle(pivot[2] - p.rear, low, front, low + p.lid)


def _barrel_profile(p: LaptopParameters, pivot: np.ndarray) -> CrossSection:
    """Section (z, y) of a barrel and of the arm that carries it."""
    low = p.slab + p.gap
    roll = CrossSection.circle(p.barrel, 20).translate((pivot[2], pivot[1]))
    arm = _rectangle(pivot[2] - min(p.rear, p.barrel), low + 0.2 * p.lid, pivot[2] + p.barrel, low + 0.5 * p.lid)
    return CrossSection.batch_hull([roll, arm])


def _rectangle(z0: float, y0: float, z1: float, y1: float) -> CrossSection:
    return polygon([(z0, y0), (z1, y0), (z1, y1), (z0, y1)])


def _swept(p: LaptopParameters, profile: CrossSection, pivot: np.ndarray) -> CrossSection:
    """All that a section of the lid passes through on its way from closed to open, with clearance."""
    z, y = pivot[2], pivot[1]
    centred = profile.translate((-z, -y))
    steps = np.linspace(0.0, p.opening, int(np.ceil(p.opening / _SWEEP_STEP_DEG)) + 1)
    passed = CrossSection.batch_boolean([centred.rotate(float(angle)) for angle in steps], OpType.Add)
    return passed.offset(_CLEARANCE).simplify(_SWEEP_TOLERANCE).translate((z, y))


def _base(p: LaptopParameters, pivot: np.ndarray) -> Manifold:
    w, d = p.width / 2, p.depth / 2
    body = rounded_box((-w, 0, -d), (w, p.slab, d), "y", p.corner, p.edge)
    if p.taper < 1:
        rise, slope = _underside(p, d + 1e-3), [(d + 1e-3, -1e-3), (_TAPER_START * p.depth, -1e-3)]
        wedge = polygon([*slope, (_TAPER_START * p.depth, 0), (d + 1e-3, rise)])
        body = subtract(body, [extrude(wedge, "x", -p.width, p.width)])
    if p.wall_height:
        body = union([body, *_side_walls(p)])
    room = _swept(p, _barrel_profile(p, pivot), pivot)
    wells, keys = _deck(p, min(room.bounds()[2] + 0.03 * p.depth, pivot[2] + 0.2 * p.depth))
    body = subtract(body, [*_hinge_room(p, pivot, room), *wells, *_sockets(p), *_underside_cuts(p)])
    # What a lid that opens far leaves standing behind it hangs on nothing.
    whole = max(body.decompose(), key=lambda solid: solid.volume())
    return union([whole, *keys, *_feet(p)])


def _hinge_room(p: LaptopParameters, pivot: np.ndarray, barrels: CrossSection) -> list[Manifold]:
    """What the lid needs to swing: its panel over its whole width, its barrels (section given) where they are."""
    half = p.lid_width / 2 + 0.5 * PLAY
    # Beyond a few thicknesses in front of the hinge, the lid only ever rises.
    panel = _panel_profile(p, pivot, pivot[2] + 3 * (p.lid + p.slab))
    ranges = [(low * p.lid_width - 4e-4, high * p.lid_width + 4e-4) for low, high in p.barrel_ranges]
    return [
        extrude(_swept(p, panel, pivot), "x", -half, half),
        *(extrude(barrels, "x", low, high) for low, high in ranges),
    ]


def _underside_cuts(p: LaptopParameters) -> list[Manifold]:
    """Slots, or the pockets of a base without a cover."""
    r, cuts = p.relief, []
    if r.vents:
        low, high = (-0.4 * p.width, -0.25 * p.depth), (0.4 * p.width, 0.1 * p.depth)
        cuts = _slots(r.vents, low[0], high[0], low[1], high[1], -1e-3, 0.4 * p.slab)
    return [*cuts, *_hollow_underside(p)] if r.underside_ribs else cuts


def _side_walls(p: LaptopParameters) -> list[Manifold]:
    w, d, top = p.width / 2, p.depth / 2, p.slab + p.wall_height
    inner, front = w - p.wall_width, -d + p.wall_length * p.depth
    outline = rounded_box((-w, 0.5 * p.slab, -d), (w, top, d), "y", p.corner, p.edge)
    keep = [(-w - 1e-3, -inner), (inner, w + 1e-3)]
    return [intersect(outline, box((x0, 0.4 * p.slab, -d - 1e-3), (x1, top + 1e-3, front))) for x0, x1 in keep]


def _hollow_underside(p: LaptopParameters) -> list[Manifold]:
    """Pockets between the ribs of an underside without a cover."""
    r, rim, rib = p.relief, 0.008, 0.002
    edges = np.linspace(-p.width / 2 + rim, p.width / 2 - rim + rib, r.underside_ribs + 2)
    # Not below the hinge, which needs something to stand on, nor where a tapered base gets thin.
    back, front = -p.depth / 2 + p.pivot[1] + 0.12 * p.depth, 0.3 * p.depth
    rise = _underside(p, front)
    roof = rise + 0.7 * (p.slab - rise)
    roof = min(roof, p.slab - r.sunk_deck - r.well - 0.15 * p.slab)
    return [box((x0, -1e-3, back), (x1 - rib, roof, front)) for x0, x1 in pairwise(edges)]


def _slots(count: int, x0: float, x1: float, z0: float, z1: float, low: float, high: float) -> list[Manifold]:
    """Parallel slots side by side, as wide as the bars between them."""
    edges = np.linspace(x0, x1, 2 * count)
    return [box((a, low, z0), (b, high, z1)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _deck(p: LaptopParameters, back: float) -> tuple[list[Manifold], list[Manifold]]:
    """What is cut out of the deck in front of `back`, and the keys that stand in it."""
    w, d, r, over = p.width / 2, p.depth / 2, p.relief, p.slab + p.wall_height + 1e-3
    top = p.slab - r.sunk_deck
    cuts, keys = [], []
    if r.sunk_deck:
        rim = 0.008 + (p.wall_width if p.wall_height else 0.0)
        cuts.append(rounded_box((-w + rim, top, back - 0.01), (w - rim, p.slab + 1e-4, d - 0.008), "y", 0.003))
    inner = p.lid_width / p.width
    half, front = 0.5 * r.keyboard_width * p.width * inner - 0.006, back + r.keyboard_depth * p.depth
    ceiling = p.slab + 1e-4 if p.wall_height else over
    if r.key_rows:
        cuts.append(rounded_box((-half, top - r.well, back), (half, ceiling, front), "y", 0.003))
        keys = _keys(p, half, back, front, top - r.well - 1e-4, top - r.key_drop * r.well)
    if r.touchpad:
        pad, near = 0.5 * r.touchpad_width * p.width, front + 0.15 * (d - front)
        far = min(near + r.touchpad_depth * p.depth, d - 0.014)
        cuts.append(rounded_box((-pad, top - r.touchpad, near), (pad, ceiling, far), "y", 0.003))
    if r.speakers:
        depth = 0.2 * min(p.slab, 0.01)
        for side in (-1, 1):
            edges = sorted((side * (half + 0.004), side * (inner * w - 0.010)))
            if edges[1] - edges[0] > 0.004:
                bars = np.linspace(back, front, 2 * r.speakers)
                cuts += [
                    box((edges[0], top - depth, z0), (edges[1], ceiling, z1))
                    for z0, z1 in zip(bars[::2], bars[1::2], strict=True)
                ]
    return cuts, keys


def _keys(p: LaptopParameters, half: float, back: float, front: float, low: float, high: float) -> list[Manifold]:
    r, margin, space = p.relief, 0.002, 0.0025
    blocks = [(-half + margin, half - margin, r.keys_per_row)]
    if r.numpad:
        left, right, _ = blocks[0]
        split = left + 0.79 * (right - left)
        blocks = [(left, split - 0.003, r.keys_per_row), (split + 0.003, right, 4)]
    rows = np.linspace(back + margin, front - margin + space, r.key_rows + 1)
    keys = []
    for left, right, count in blocks:
        for row, (z0, z1) in enumerate(zip(rows[:-1], rows[1:] - space, strict=True)):
            columns = np.linspace(left, right + space, count + 1)
            spans = list(zip(columns[:-1], columns[1:] - space, strict=True))
            if row == r.key_rows - 1 and count > 6:  # the space bar replaces the middle keys
                first, last = count // 4, count - count // 4 - 1
                spans = [*spans[:first], (spans[first][0], spans[last][1]), *spans[last + 1 :]]
            keys += [box((x0, low, z0), (x1, high, z1)) for x0, x1 in spans]
    return keys


def _sockets(p: LaptopParameters) -> list[Manifold]:
    y, half_height, reach = 0.62 * p.slab, min(0.0025, 0.16 * p.slab), 0.004
    sockets = []
    for side, rear, width in p.relief.ports:
        x, z = side * p.width / 2, (rear - 0.5) * p.depth
        low, high = (x - reach, y - half_height, z), (x + reach, y + half_height, z + width)
        sockets.append(rounded_box(low, high, "x", 0.8 * half_height, segments=8))
    return sockets


def _underside(p: LaptopParameters, z: float) -> float:
    """Height of the base's lower face, which rises linearly to the front of a tapered base."""
    start = _TAPER_START * p.depth
    return max(0.0, p.slab * (1 - p.taper) * (z - start) / (p.depth / 2 - start))


def _feet(p: LaptopParameters) -> list[Manifold]:
    if p.foot_height <= 0:
        return []
    x, z = 0.40 * p.width, 0.38 * p.depth
    feet = []
    for side_z in (-1, 1):
        low = -p.foot_height
        high = _underside(p, side_z * z + 0.006) + 0.1 * p.slab
        if p.foot_strips:
            feet.append(rounded_box((-x, low, side_z * z - 0.004), (x, high, side_z * z + 0.004), "y", 0.0039))
        else:
            feet += [cylinder((side * x, 0, side_z * z), "y", low, high, 0.006) for side in (-1, 1)]
    return feet


def _lid(p: LaptopParameters, pivot: np.ndarray) -> Manifold:
    w, r, low = p.lid_width / 2, p.relief, p.slab + p.gap
    back, front = pivot[2] - p.rear, pivot[2] - p.rear + p.lid_depth
    high = low + p.lid - (r.logo_height if r.logo == "bump" else 0.0)
    panel = rounded_box((-w, low, back), (w, high, front), "y", p.corner, min(p.edge, 0.25 * (high - low)))
    barrel = _barrel_profile(p, pivot)
    rolls = [extrude(barrel, "x", x0 * p.lid_width, x1 * p.lid_width) for x0, x1 in p.barrel_ranges]
    cuts = []
    if r.screen_depth:
        sides = (max(back + r.chin, pivot[2] + p.barrel + 0.002), front - 1.1 * r.bezel)
        screen = rounded_rectangle(2 * (w - r.bezel), sides[1] - sides[0], 0.002)
        cuts.append(extrude(screen, "y", low - 1e-3, low + r.screen_depth).translate((0, 0, sum(sides) / 2)))
        lens = min(0.0025, 0.35 * r.bezel)
        cuts.append(cylinder((0, 0, front - 0.55 * r.bezel), "y", low - 1e-3, low + 0.1 * p.lid, lens, segments=12))
    extra, outer_cuts = _outer_face(p, back, front, high)
    return union([subtract(panel, [*cuts, *outer_cuts]), *rolls, *extra])


def _outer_face(p: LaptopParameters, back: float, front: float, high: float) -> tuple[list[Manifold], list[Manifold]]:
    """What stands on the outer face of the lid, and what is cut out of it."""
    r, w, middle = p.relief, p.lid_width / 2, (back + front) / 2
    size = r.logo_size * p.lid_width
    ribs = np.linspace(-0.85 * w, 0.85 * w, r.back_ribs + 2)[1:-1]
    if r.logo == "hollow":
        rim, rib = 0.008, 0.0015
        edges = np.array([-w + rim, *ribs, w - rim])
        floor = high - r.logo_height
        pockets = zip(edges[:-1] + rib / 2, edges[1:] - rib / 2, strict=True)
        start = max(back + rim, -p.depth / 2 + p.pivot[1] + p.barrel + 0.004)
        return [], [box((x0, floor, start), (x1, high + 1e-3, front - rim)) for x0, x1 in pockets]
    grooves = [box((x - 0.002, high - 0.12 * p.lid, back + 0.02), (x + 0.002, high + 0.01, front - 0.02)) for x in ribs]
    if r.logo == "bump":
        return [cylinder((0, 0, middle), "y", high - 1e-4, high + r.logo_height, size / 2)], grooves
    if r.logo == "recess":
        plate = rounded_box(
            (-size / 2, high - r.logo_height, middle - 0.35 * size),
            (size / 2, high + 1e-3, middle + 0.35 * size),
            "y",
            0.3 * size,
        )
        return [], [plate, *grooves]
    return [], grooves
