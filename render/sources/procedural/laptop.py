"""Laptops: a base with keyboard deck and touchpad, and a thin lid with a screen behind a bezel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from manifold3d import Manifold

from render.sources.procedural.design import Design, hinge
from render.sources.procedural.shapes import box, cylinder, extrude, polygon, rounded_box, subtract, union


@dataclass(frozen=True)
class LaptopParameters:
    """Sizes in metres.

    `taper` is the share of the base thickness that is left at the front edge, `hinge_inset` how far the base reaches
    behind the hinge, `ports` are side (-1 or 1), distance from the rear and width of the sockets.
    """

    width: float
    depth: float
    base_thickness: float
    lid_thickness: float
    corner: float
    edge: float
    taper: float
    bezel: float
    chin: float
    keyboard_width: float
    keyboard_depth: float
    key_rows: int
    keys_per_row: int
    numpad: bool
    touchpad_width: float
    touchpad_depth: float
    full_width_hinge: bool
    hinge_radius: float
    hinge_inset: float
    ports: tuple[tuple[float, float, float], ...]
    foot_strips: bool
    foot_height: float


_LARGEST_OPENING_DEG = 100.0  # beyond, the lid's rear edge would meet the base
_TAPER_START = -0.3  # where the underside starts to rise, in depths from the middle


def sample_laptop(rng: np.random.Generator) -> LaptopParameters:
    """Laptops of all ages: from thick and nearly square to flat and wide."""
    width = rng.uniform(0.26, 0.42)
    return _sample(
        rng,
        width=width,
        depth=width * rng.uniform(0.60, 0.80),
        base_thickness=rng.uniform(0.014, 0.032),
        lid_share=rng.uniform(0.30, 0.48),
        bezel=rng.uniform(0.006, 0.022),
    )


# Width, depth and closed height of common product classes, metres: 11", 13" and 14" ultrabooks, 14" and 15" business
# machines, 15" and 17" consumer and gaming machines.
_PRODUCTS = (
    (0.300, 0.192, 0.0172),
    (0.304, 0.212, 0.0161),
    (0.296, 0.199, 0.0148),
    (0.313, 0.221, 0.0155),
    (0.314, 0.223, 0.0149),
    (0.329, 0.227, 0.0179),
    (0.336, 0.232, 0.0190),
    (0.344, 0.230, 0.0180),
    (0.349, 0.241, 0.0162),
    (0.358, 0.236, 0.0199),
    (0.361, 0.256, 0.0227),
    (0.359, 0.254, 0.0235),
    (0.397, 0.274, 0.0250),
)


def sample_laptop_real(rng: np.random.Generator) -> LaptopParameters:
    """Laptops with the outer sizes of real products, within two per cent."""
    width, depth, height = np.array(_PRODUCTS[rng.integers(len(_PRODUCTS))]) * rng.uniform(0.98, 1.02, 3)
    lid_share = rng.uniform(0.26, 0.34)
    return _sample(
        rng,
        width=width,
        depth=depth,
        base_thickness=height / (1 + lid_share),
        lid_share=lid_share,
        bezel=rng.uniform(0.005, 0.014),
    )


def _sample(
    rng: np.random.Generator, width: float, depth: float, base_thickness: float, lid_share: float, bezel: float
) -> LaptopParameters:
    """Draw what does not distinguish the two categories. `lid_share` is lid over base thickness."""
    boxy = rng.random() < 0.4
    hinge_radius = float(np.clip(base_thickness * rng.uniform(0.22, 0.32), 0.003, 0.007))
    keyboard_width = width * rng.uniform(0.82, 0.93)
    return LaptopParameters(
        width=width,
        depth=depth,
        base_thickness=base_thickness,
        lid_thickness=float(np.clip(base_thickness * lid_share, 0.0045, 0.013)),
        corner=rng.uniform(0.002, 0.005) if boxy else rng.uniform(0.008, 0.020),
        edge=rng.uniform(0.0004, 0.0008) if boxy else rng.uniform(0.001, 0.0018),
        taper=1.0 if boxy else rng.uniform(0.55, 1.0),
        bezel=bezel,
        chin=bezel * rng.uniform(1.2, 2.2) + hinge_radius,
        keyboard_width=keyboard_width,
        keyboard_depth=depth * rng.uniform(0.40, 0.46),
        key_rows=int(rng.integers(5, 7)),
        keys_per_row=int(rng.integers(11, 15)),
        numpad=bool(keyboard_width > 0.31 and rng.random() < 0.6),
        touchpad_width=width * rng.uniform(0.26, 0.42),
        touchpad_depth=depth * rng.uniform(0.24, 0.32),
        full_width_hinge=bool(rng.random() < 0.4),
        hinge_radius=hinge_radius,
        hinge_inset=depth * rng.uniform(0.03, 0.10) if rng.random() < 0.2 else 0.0,
        ports=tuple(
            (side, depth * (0.2 + 0.13 * place), rng.uniform(0.008, 0.016))
            for side in (-1.0, 1.0)
            for place in range(4)
            if rng.random() < 0.6
        ),
        foot_strips=bool(rng.random() < 0.35),
        foot_height=rng.uniform(0.001, 0.0025),
    )


def build(p: LaptopParameters) -> Design:
    """Base and lid, closed. The hinge line runs along the rear edge, between the two."""
    top, gap = p.base_thickness, 0.0003
    pivot = np.array([0.0, top + gap + 0.3 * p.hinge_radius, -p.depth / 2 + p.hinge_radius + p.hinge_inset])
    barrels = _barrel_ranges(p)
    return Design(
        parts={"base": _base(p, pivot, barrels), "lid": _lid(p, pivot, barrels, top + gap)},
        joints=(hinge("lid_hinge", 1, (-1.0, 0.0, 0.0), pivot, upper_deg=_LARGEST_OPENING_DEG),),
    )


def _barrel_ranges(p: LaptopParameters) -> list[tuple[float, float]]:
    if p.full_width_hinge:
        return [(-0.40 * p.width, 0.40 * p.width)]
    half, center = 0.055 * p.width, 0.33 * p.width
    return [(side * center - half, side * center + half) for side in (-1, 1)]


def _base(p: LaptopParameters, pivot: np.ndarray, barrels: list[tuple[float, float]]) -> Manifold:
    w, d, top = p.width / 2, p.depth / 2, p.base_thickness
    body = rounded_box((-w, 0, -d), (w, top, d), "y", p.corner, p.edge)
    if p.taper < 1:
        rise, slope = _underside(p, d + 1e-3), [(d + 1e-3, -1e-3), (_TAPER_START * p.depth, -1e-3)]
        wedge = polygon([*slope, (_TAPER_START * p.depth, 0), (d + 1e-3, rise)])
        body = subtract(body, [extrude(wedge, "x", -p.width, p.width)])
    # The lid swings behind the hinge line: nothing of the base may stand there except below the barrels.
    notch = p.hinge_radius * 1.12
    cuts = [cylinder(pivot, "x", low - 4e-4, high + 4e-4, notch) for low, high in barrels]
    cuts.append(box((-p.width, top - p.lid_thickness * 0.35, -d - 1e-3), (p.width, top + 1e-3, pivot[2])))
    keyboard_back = pivot[2] + notch + 0.05 * p.depth
    keyboard_front = keyboard_back + p.keyboard_depth
    recess = 0.0016
    half = p.keyboard_width / 2
    cuts.append(rounded_box((-half, top - recess, keyboard_back), (half, top + 1e-3, keyboard_front), "y", 0.003))
    pad_back = keyboard_front + 0.15 * (d - keyboard_front)
    pad_front = min(pad_back + p.touchpad_depth, d - 0.006)
    cuts.append(
        rounded_box(
            (-p.touchpad_width / 2, top - 0.0007, pad_back), (p.touchpad_width / 2, top + 1e-3, pad_front), "y", 0.003
        )
    )
    cuts += _sockets(p)
    keys = _keys(p, keyboard_back, keyboard_front, top - recess - 1e-4, top - 0.0003)
    return union([subtract(body, cuts), *keys, *_feet(p)])


def _sockets(p: LaptopParameters) -> list[Manifold]:
    y, half_height, reach = 0.62 * p.base_thickness, min(0.0025, 0.16 * p.base_thickness), 0.004
    sockets = []
    for side, rear, width in p.ports:
        x, z = side * p.width / 2, rear - p.depth / 2
        low, high = (x - reach, y - half_height, z), (x + reach, y + half_height, z + width)
        sockets.append(rounded_box(low, high, "x", 0.8 * half_height, segments=8))
    return sockets


def _keys(p: LaptopParameters, back: float, front: float, low: float, high: float) -> list[Manifold]:
    margin, space = 0.002, 0.0025
    blocks = [(-p.keyboard_width / 2 + margin, p.keyboard_width / 2 - margin, p.keys_per_row)]
    if p.numpad:
        left, right, _ = blocks[0]
        split = left + 0.79 * (right - left)
        blocks = [(left, split - 0.003, p.keys_per_row), (split + 0.003, right, 4)]
    rows = np.linspace(back + margin, front - margin + space, p.key_rows + 1)
    keys = []
    for left, right, count in blocks:
        for row, (z0, z1) in enumerate(zip(rows[:-1], rows[1:] - space, strict=True)):
            columns = np.linspace(left, right + space, count + 1)
            spans = list(zip(columns[:-1], columns[1:] - space, strict=True))
            if row == p.key_rows - 1 and count > 6:  # the space bar replaces the middle keys
                first, last = count // 4, count - count // 4 - 1
                spans = [*spans[:first], (spans[first][0], spans[last][1]), *spans[last + 1 :]]
            keys += [box((x0, low, z0), (x1, high, z1)) for x0, x1 in spans]
    return keys


def _underside(p: LaptopParameters, z: float) -> float:
    """Height of the base's lower face, which rises linearly to the front of a tapered base."""
    start = _TAPER_START * p.depth
    return max(0.0, p.base_thickness * (1 - p.taper) * (z - start) / (p.depth / 2 - start))


def _feet(p: LaptopParameters) -> list[Manifold]:
    x, z = 0.40 * p.width, 0.38 * p.depth
    feet = []
    for side_z in (-1, 1):
        low = _underside(p, side_z * z - 0.006) - p.foot_height
        high = _underside(p, side_z * z + 0.006) + 0.1 * p.base_thickness
        if p.foot_strips:
            feet.append(rounded_box((-x, low, side_z * z - 0.004), (x, high, side_z * z + 0.004), "y", 0.0039))
        else:
            feet += [cylinder((side * x, 0, side_z * z), "y", low, high, 0.006) for side in (-1, 1)]
    return feet


def _lid(p: LaptopParameters, pivot: np.ndarray, barrels: list[tuple[float, float]], low: float) -> Manifold:
    w, d = p.width / 2, p.depth / 2
    high = low + p.lid_thickness
    panel = rounded_box((-w, low, pivot[2]), (w, high, d), "y", p.corner, min(p.edge, p.lid_thickness / 4))
    screen = rounded_box(
        (-w + p.bezel, low - 1e-3, pivot[2] + p.chin), (w - p.bezel, low + 0.0012, d - p.bezel * 1.1), "y", 0.002
    )
    rolls = [cylinder(pivot, "x", x0, x1, p.hinge_radius) for x0, x1 in barrels]
    camera = cylinder(
        (0, 0, d - 0.55 * p.bezel), "y", low - 1e-3, low + 0.0006, min(0.0025, 0.35 * p.bezel), segments=12
    )
    return union([subtract(panel, [screen, camera]), *rolls])
