"""Safes: a thick body with cavity and shelf, and a thick side-hinged door with keypad or dial, handle and bolt work."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from manifold3d import Manifold

from render.sources.procedural.design import Design, hinge
from render.sources.procedural.fittings import OVERLAP, bar_handle, feet
from render.sources.procedural.shapes import box, cylinder, extrude, polygon, rounded_box, subtract, union

_GAP = 0.002  # between door and body
_KNUCKLE_RADIUS = 0.0075
_INSET_HINGE = (0.012, 0.008)  # an inset door's hinge line: outside the opening, in front of the body
_MOUNT = 0.005  # half thickness of what carries the knuckles


@dataclass(frozen=True)
class SafeParameters:
    """Sizes in metres. An inset door closes flush in its opening, an overlay door lies on the body's front."""

    width: float
    height: float
    depth: float
    wall: float
    corner: float
    door_thickness: float
    inset_door: bool
    right_hinged: bool
    hinges: int
    keypad: bool
    dial: bool
    handle: str
    handle_radius: float
    lock_height: float
    shelf: bool
    bolts: int
    feet: bool


# Width, height and depth of common product classes, metres: hotel and laptop safes, home safes, document safes, and
# small fire safes.
_PRODUCTS = (
    (0.310, 0.200, 0.200),
    (0.350, 0.250, 0.250),
    (0.430, 0.200, 0.370),
    (0.380, 0.300, 0.300),
    (0.360, 0.420, 0.370),
    (0.400, 0.500, 0.350),
    (0.440, 0.520, 0.440),
    (0.450, 0.600, 0.450),
    (0.415, 0.348, 0.491),
)


def sample(rng: np.random.Generator) -> SafeParameters:
    """Safes with the outer sizes of real product classes, within eight per cent."""
    width, height, depth = np.array(_PRODUCTS[rng.integers(len(_PRODUCTS))]) * rng.uniform(0.92, 1.08, 3)
    heavy = _is_tall(height)
    lock = rng.choice(["keypad", "dial", "both"], p=[0.5, 0.3, 0.2] if heavy else [0.65, 0.35, 0.0])
    return SafeParameters(
        width=width,
        height=height,
        depth=depth,
        wall=rng.uniform(0.030, 0.055) if heavy else rng.uniform(0.014, 0.026),
        corner=rng.uniform(0.001, 0.02),
        door_thickness=rng.uniform(0.030, 0.055) if heavy else rng.uniform(0.018, 0.030),
        inset_door=bool(rng.random() < 0.65),
        right_hinged=bool(rng.random() < 0.3),
        hinges=int(rng.integers(2, 4)) if heavy else 2,
        keypad=lock in ("keypad", "both"),
        dial=lock in ("dial", "both"),
        handle=str(rng.choice(["lever", "wheel", "bar", "turn"])),
        handle_radius=rng.uniform(0.006, 0.010),
        lock_height=rng.uniform(0.58, 0.70),
        shelf=bool(heavy and rng.random() < 0.7),
        bolts=int(rng.integers(2, 5)),
        feet=bool(rng.random() < 0.5),
    )


def _is_tall(height: float) -> bool:
    return height > 0.33


def build(p: SafeParameters) -> Design:
    """Body and closed door, made with the hinge on the left; a right-hinged safe is its mirror image."""
    front = p.depth / 2
    if p.inset_door:
        pivot = np.array([-p.width / 2 + p.wall - _INSET_HINGE[0], p.height / 2, front + _INSET_HINGE[1]])
    else:
        pivot = np.array([-p.width / 2 - _KNUCKLE_RADIUS, p.height / 2, front + _GAP + 0.5 * p.door_thickness])
    parts = {"body": _body(p, front, pivot), "door": _door(p, front, pivot)}
    axis = np.array([0.0, -1.0, 0.0])
    if p.right_hinged:
        parts = {name: solid.mirror((1.0, 0.0, 0.0)) for name, solid in parts.items()}
        # The mirror image of a rotation turns the other way about the mirrored line: opening stays positive.
        pivot, axis = pivot * (-1.0, 1.0, 1.0), -axis
    return Design(parts, (hinge("door_hinge", 1, axis, pivot, upper_deg=135.0),))


def _body(p: SafeParameters, front: float, pivot: np.ndarray) -> Manifold:
    w, h = p.width / 2, p.height
    inner = w - p.wall
    shell = rounded_box((-w, 0, -front), (w, h, front), "z", p.corner, 0.002)
    inside = box((-inner, p.wall, -front + p.wall), (inner, h - p.wall, front + 0.01))
    solids = [subtract(shell, [inside])]
    if p.shelf:
        y, reach = 0.48 * h, front - p.door_thickness - 0.07
        solids.append(box((-inner - OVERLAP, y, -front + p.wall - OVERLAP), (inner + OVERLAP, y + 0.006, reach)))
    if p.feet:
        solids += feet(w - 0.04, -front + 0.04, front - 0.04, 0.0, 0.012, 0.018, square=False)
    for low, high in _knuckles(p):
        solids += _body_knuckle(p, front, pivot, (low + high) / 2 + 2e-4, high)
    return union(solids)


def _body_knuckle(p: SafeParameters, front: float, pivot: np.ndarray, low: float, high: float) -> list[Manifold]:
    x, _, z = pivot
    if p.inset_door:
        mount = box((x - _MOUNT, low, front - 0.004), (x + _MOUNT, high, z))
    else:  # an angle from the side wall to the hinge line in front of it
        into_wall = -p.width / 2 + 0.002
        plate = box((x - _MOUNT, low, front - 0.02), (into_wall, high, front - 0.004))
        mount = union([plate, box((x - _MOUNT, low, front - 0.02), (x + 0.002, high, z))])
    return [cylinder(pivot, "y", low, high, _KNUCKLE_RADIUS, segments=16), mount]


def _knuckles(p: SafeParameters) -> list[tuple[float, float]]:
    """Height ranges of the hinges; the body's knuckle is the upper half, the door's the lower."""
    half = min(0.03, 0.09 * p.height)
    return [(y - half, y + half) for y in np.linspace(0.2, 0.8, p.hinges) * p.height]


def _door(p: SafeParameters, front: float, pivot: np.ndarray) -> Manifold:
    w, h, t = p.width / 2, p.height, p.door_thickness
    low, high = p.wall + _GAP, h - p.wall - _GAP
    left, right = -w + p.wall + _GAP, w - p.wall - _GAP
    if p.inset_door:
        face = front + _GAP
        slab = _swinging_prism(left, right, low, high, face - t, face, pivot)
        plate_back = face - t
    else:
        face = front + _GAP + t
        slab = rounded_box((-w + 0.001, 0.001, front + _GAP), (w - 0.001, h - 0.001, face), "z", p.corner, 0.003)
        plate_back = front - 0.35 * t
        back = _swinging_prism(left + 0.006, right, low + 0.004, high - 0.004, plate_back, front + 2 * _GAP, pivot)
        slab = union([slab, back])
    solids = [slab, *_bolt_work(p, left, right, low, high, plate_back), *_fittings(p, left, right, face)]
    for bottom, top in _knuckles(p):
        x, _, z = pivot
        middle = (bottom + top) / 2
        solids.append(cylinder(pivot, "y", bottom, middle - 2e-4, _KNUCKLE_RADIUS, segments=16))
        # Before the body's front for inset doors, in the middle of the slab for others.
        leaf_back, leaf_front = (front + 0.0015, z - 0.002) if p.inset_door else (z - 0.003, z + 0.003)
        solids.append(box((x, bottom, leaf_back), (left + 0.02, middle - 2e-4, leaf_front)))
    return union(solids)


def _swinging_prism(
    left: float, right: float, low: float, high: float, back: float, face: float, pivot: np.ndarray
) -> Manifold:
    """Slab whose free edge is bevelled as far as it must be to swing clear of its frame about the pivot."""
    reach = right - pivot[0]
    free = pivot[0] + np.sqrt(reach**2 - (pivot[2] - back) ** 2)
    outline = polygon([(left, back), (free, back), (right, min(face, pivot[2])), (right, face), (left, face)])
    return extrude(outline, "y", low, high)


def _bolt_work(p: SafeParameters, left: float, right: float, low: float, high: float, back: float) -> list[Manifold]:
    """Cover plate on the inner side of the door, and locking bolts drawn back into it."""
    x0, x1 = left + 0.14 * (right - left), left + 0.90 * (right - left)
    y0, y1 = low + 0.12 * (high - low), high - 0.12 * (high - low)
    thickness = 0.014
    cover = rounded_box((x0, y0, back - thickness), (x1, y1, back + OVERLAP), "z", 0.008, 0.001)
    radius = min(0.009, 0.25 * thickness + 0.003)
    bolts = [
        cylinder((0, y, back - radius), "x", x1 - 0.02, x1 + 0.012, radius, segments=12)
        for y in np.linspace(y0 + 0.2 * (y1 - y0), y1 - 0.2 * (y1 - y0), p.bolts)
    ]
    return [cover, *bolts]


def _fittings(p: SafeParameters, left: float, right: float, face: float) -> list[Manifold]:
    """Lock and handle: one above the other on tall doors, side by side on flat ones."""
    span, scale, h = right - left, min(1.0, (right - left) / 0.26), p.height
    if _is_tall(h):
        lock, grip = (left + 0.54 * span, p.lock_height * h), (left + 0.60 * span, 0.34 * h)
    else:
        lock, grip = (left + 0.36 * span, 0.5 * h), (left + 0.74 * span, 0.5 * h)
    second = lock
    if p.keypad and p.dial:
        lock, second = (left + 0.30 * span, lock[1]), (left + 0.70 * span, lock[1])
    solids = [_handle(p, (*grip, face), scale)]
    if p.keypad:
        solids += _keypad(lock, face, scale)
    if p.dial:
        solids.append(_dial(second, face, 0.03 * scale))
    return solids


def _keypad(center: tuple[float, float], face: float, scale: float) -> list[Manifold]:
    x, y = center
    w, h, key = 0.036 * scale, 0.048 * scale, 0.0075 * scale
    plate = rounded_box((x - w, y - h, face - OVERLAP), (x + w, y + h, face + 0.008), "z", 0.008, 0.001)
    display = rounded_box(
        (x - 0.75 * w, y + 0.5 * h, face + 0.005), (x + 0.75 * w, y + 0.85 * h, face + 0.1), "z", 0.002
    )
    keys = [
        rounded_box((u - key, v - 0.8 * key, face + 0.007), (u + key, v + 0.8 * key, face + 0.011), "z", 0.002)
        for u in x + np.array([-0.6, 0.0, 0.6]) * w
        for v in y + np.array([-0.74, -0.38, -0.02, 0.34]) * h
    ]
    return [subtract(plate, [display]), *keys]


def _dial(center: tuple[float, float], face: float, radius: float) -> Manifold:
    middle = (*center, 0.0)
    ring = cylinder(middle, "z", face - OVERLAP, face + 0.007, 1.25 * radius)
    scale = cylinder(middle, "z", face, face + 0.016, 1.05 * radius, 0.85 * radius)
    grip = cylinder(middle, "z", face, face + 0.034, 0.55 * radius, 0.48 * radius)
    angles = np.arange(8) * np.pi / 4
    rim = np.array(center) + 0.62 * radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    flutes = [cylinder((*u, 0), "z", face + 0.018, face + 0.1, 0.16 * radius, segments=8) for u in rim]
    return subtract(union([ring, scale, grip]), flutes)


def _handle(p: SafeParameters, center: tuple[float, float, float], scale: float) -> Manifold:
    x, y, z = center
    r, arm = p.handle_radius, 0.055 * scale
    if p.handle == "bar":
        return bar_handle(
            center, "y", min(0.13, (0.26 if _is_tall(p.height) else 0.5) * p.height), 0.035, r, square=True
        )
    hub = cylinder(center, "z", z - OVERLAP, z + 0.03, 1.6 * r)
    rose = cylinder(center, "z", z - OVERLAP, z + 0.006, 2.4 * r)
    if p.handle == "turn":
        wing = rounded_box((-0.5 * arm, -0.8 * r, 0.018), (0.5 * arm, 0.8 * r, 0.045), "z", 0.7 * r)
        return union([hub, rose, wing.rotate((0, 0, 90)).translate(center)])
    spoke = cylinder((0, 0, 0.026), "x", 0.0, arm, r, 0.7 * r, segments=12)
    ball = Manifold.sphere(1.15 * r, 12).translate((arm, 0, 0.026))
    angles = (-25.0,) if p.handle == "lever" else (90.0, 210.0, 330.0)
    return union([hub, rose, *(union([spoke, ball]).rotate((0, 0, a)).translate((x, y, z)) for a in angles)])
