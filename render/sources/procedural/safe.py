"""Safes: a thick body with cavity and shelf, and a thick side-hinged door with keypad or dial, handle and bolt work."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from manifold3d import Manifold

from render.sources.procedural.design import Design, from_quantiles, hinge
from render.sources.procedural.fittings import OVERLAP, bar_handle, feet
from render.sources.procedural.shapes import box, cylinder, extrude, polygon, rounded_box, subtract, union

_GAP = 0.002  # between door and body
_CLEARANCE = 5e-4  # between knuckles and the front of the body
_LAP = 0.012  # of an overlay door over the edge of its opening
_BESIDE = 0.0045  # from an inset door's opening to the knuckles, which stand in front of the body
_THINNEST_WALL = 0.008

# Minimum, quartiles and maximum of 16 CAD safes (findings of 2026-11-21, section 1, which states minima, medians and
# maxima; the quartiles lie between them). Body: share of the diagonal of its box. Door: share of the body's box, and
# thickness with all that stands on the door in diagonals.
_BODY_WIDTH = (0.38, 0.45, 0.50, 0.54, 0.58)
_BODY_HEIGHT = (0.53, 0.59, 0.64, 0.71, 0.86)
_BODY_DEPTH = (0.30, 0.43, 0.53, 0.60, 0.69)
_DOOR_WIDTH = (0.70, 0.79, 0.84, 0.88, 0.93)
_DOOR_HEIGHT = (0.59, 0.76, 0.84, 0.87, 0.91)
_DOOR_THICKNESS = (0.011, 0.05, 0.073, 0.095, 0.144)
RIGHT_HINGED = 1 / 16  # 15 of the 16 are hinged on the same side


@dataclass(frozen=True)
class SafeParameters:
    """Sizes in metres. An inset door closes flush in its opening, an overlay door lies on the body's front.

    Attributes:
        width: Of the body; the body is as high as `height` and as deep as `depth`.
        wall: Thickness of the back and, at least, of the other walls.
        door_low: Lower left corner of the slab of the door (x, y), hinged on the left ...
        door_high: ... and its upper right one.
        slab: Thickness of the slab of the door.
        knuckle: Radius of the hinges.
        bolt_work: Thickness of the cover behind the slab; 0 if there is none.
        cover_slots: In that cover.
        fittings: How far lock and handle stand out; 0 for a bare door.
        plug: Share of the slab that an overlay door reaches into the opening.
        shelves: In the body.
    """

    width: float
    height: float
    depth: float
    wall: float
    corner: float
    door_low: tuple[float, float]
    door_high: tuple[float, float]
    slab: float
    inset_door: bool
    right_hinged: bool
    hinges: int
    knuckle: float
    bolt_work: float
    bolts: int
    cover_slots: int
    fittings: float
    plug: float
    keypad: bool
    dial: bool
    handle: str
    handle_radius: float
    lock_height: float
    shelves: int
    feet: bool

    @property
    def door_span(self) -> tuple[float, float]:
        """Width and height of the slab of the door."""
        return self.door_high[0] - self.door_low[0], self.door_high[1] - self.door_low[1]


def sample(rng: np.random.Generator, right_hinged: float = RIGHT_HINGED) -> SafeParameters:
    """Safes of all proportions, from boxes for documents to cabinets; `right_hinged` is their share."""
    size = _draw_body(rng) * rng.uniform(0.42, 1.3)
    width, height, depth = size
    diagonal = float(np.linalg.norm(size))
    inset = bool(rng.random() < 0.6)
    thickness = diagonal * from_quantiles(rng, *_DOOR_THICKNESS)
    knuckle = float(np.clip(0.16 * thickness, 0.0012, 0.0085))
    plug = rng.uniform(0.2, 0.5) if not inset and rng.random() < 0.5 else 0.0
    slab, bolt_work, fittings = _share_out(rng, thickness, 2 * knuckle if inset else 0.0)
    beside = 2 * knuckle + (_GAP + _BESIDE if inset else 0.0)
    low, high = _draw_door(rng, width, height, beside)
    lock = rng.choice(["keypad", "dial", "both"], p=[0.5, 0.3, 0.2] if _is_tall(height) else [0.65, 0.35, 0.0])
    return SafeParameters(
        width=width,
        height=height,
        depth=depth,
        wall=max(_THINNEST_WALL, min(rng.uniform(0.012, 0.06), 0.12 * width)),
        corner=rng.uniform(0.001, 0.02),
        door_low=low,
        door_high=high,
        slab=(slab - _GAP) / (1 + plug) if plug else slab,
        inset_door=inset,
        right_hinged=bool(rng.random() < right_hinged),
        hinges=int(rng.integers(2, 4)) if _is_tall(height) else 2,
        knuckle=knuckle,
        bolt_work=bolt_work,
        bolts=int(rng.integers(2, 5)),
        cover_slots=int(rng.integers(4, 24)) if rng.random() < 0.35 else 0,
        fittings=fittings,
        plug=plug,
        keypad=lock in ("keypad", "both"),
        dial=lock in ("dial", "both"),
        handle=str(rng.choice(["lever", "wheel", "bar", "turn"])),
        handle_radius=rng.uniform(0.006, 0.010),
        lock_height=rng.uniform(0.58, 0.70),
        shelves=int(rng.choice([0, 1, 2, 3], p=[0.6, 0.25, 0.1, 0.05])),
        feet=bool(rng.random() < 0.5),
    )


def _draw_body(rng: np.random.Generator) -> np.ndarray:  # [3]
    """Width, height and depth of a body with a diagonal of 1."""
    measured = np.array([_BODY_WIDTH, _BODY_HEIGHT, _BODY_DEPTH])
    while True:
        size = np.array([from_quantiles(rng, *quantiles) for quantiles in measured])
        size /= np.linalg.norm(size)
        if (measured[:, 0] <= size).all() and (size <= measured[:, -1]).all():
            return size


def _share_out(rng: np.random.Generator, thickness: float, hinges: float) -> tuple[float, float, float]:
    """Thickness of slab, bolt work behind it and fittings before it, which add up; hinges stand before it too."""
    fittings = max(hinges, rng.uniform(0.2, 0.6) * min(thickness, 0.1))
    bolt_work = min(rng.uniform(0.006, 0.03), 0.3 * thickness) if thickness > 0.03 and rng.random() < 0.6 else 0.0
    return thickness - fittings - bolt_work, bolt_work, fittings


def _draw_door(
    rng: np.random.Generator, width: float, height: float, beside: float
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Lower left and upper right corner of the slab of a left-hinged door; its hinges take `beside` next to it."""
    share = np.array([from_quantiles(rng, *_DOOR_WIDTH), from_quantiles(rng, *_DOOR_HEIGHT)])
    size = share * (width, height)
    rest = height - size[1]
    # What is left above and below is shared unevenly: a drawer or a plinth below, for example.
    low = rest * rng.uniform(0.5, 0.8) if rest > 0.2 * height else rest / 2
    left = -0.5 * size[0] + beside
    return (left, low), (0.5 * size[0], low + size[1])


def _is_tall(height: float) -> bool:
    return height > 0.33


def build(p: SafeParameters) -> Design:
    """Body and closed door, made with the hinge on the left; a right-hinged safe is its mirror image."""
    front, r = p.depth / 2, p.knuckle
    middle = (p.door_low[1] + p.door_high[1]) / 2
    if p.inset_door:
        pivot = np.array([p.door_low[0] - _GAP - _BESIDE - r, middle, front + r + _CLEARANCE])
    else:
        pivot = np.array([p.door_low[0] - r, middle, front + max(_GAP + 0.5 * p.slab, r + _CLEARANCE)])
    parts = {"body": _body(p, front, pivot), "door": _door(p, front, pivot)}
    axis = np.array([0.0, -1.0, 0.0])
    if p.right_hinged:
        parts = {name: solid.mirror((1.0, 0.0, 0.0)) for name, solid in parts.items()}
        # The mirror image of a rotation turns the other way about the mirrored line: opening stays positive.
        pivot, axis = pivot * (-1.0, 1.0, 1.0), -axis
    return Design(parts, (hinge("door_hinge", 1, axis, pivot, upper_deg=135.0),))


def _opening(p: SafeParameters) -> tuple[np.ndarray, np.ndarray]:
    """Lower left and upper right corner of the opening in the front."""
    margin = -_GAP if p.inset_door else _LAP
    return np.array(p.door_low) + margin, np.array(p.door_high) - margin


def _body(p: SafeParameters, front: float, pivot: np.ndarray) -> Manifold:
    w, h = p.width / 2, p.height
    low, high = _opening(p)
    shell = rounded_box((-w, 0, -front), (w, h, front), "z", min(p.corner, 0.8 * (w - high[0])), 0.002)
    solids = [subtract(shell, [box((*low, -front + p.wall), (*high, front + 0.01))])]
    reach = front - p.slab - p.bolt_work - 0.03
    for y in np.linspace(low[1], high[1], p.shelves + 2)[1:-1]:
        if reach > -front + p.wall + 0.02:
            shelf = ((low[0] - OVERLAP, y, -front + p.wall - OVERLAP), (high[0] + OVERLAP, y + 0.006, reach))
            solids.append(box(*shelf))
    if p.feet:
        solids += feet(w - 0.04, -front + 0.04, front - 0.04, 0.0, 0.012, 0.018, square=False)
    x, _, z = pivot
    for bottom, top in _knuckles(p):
        lower = (bottom + top) / 2 + 2e-4
        solids.append(cylinder(pivot, "y", lower, top, p.knuckle, segments=16))
        solids.append(box((x - 0.7 * p.knuckle, lower, front - 0.004), (x + 0.7 * p.knuckle, top, z)))
    return union(solids)


def _knuckles(p: SafeParameters) -> list[tuple[float, float]]:
    """Height ranges of the hinges; the body's knuckle is the upper half, the door's the lower."""
    _, height = p.door_span
    half = min(0.03, 0.09 * height)
    return [(y - half, y + half) for y in p.door_low[1] + np.linspace(0.15, 0.85, p.hinges) * height]


def _door(p: SafeParameters, front: float, pivot: np.ndarray) -> Manifold:
    (left, low), (right, high), t = p.door_low, p.door_high, p.slab
    if p.inset_door:
        face, back = front, front - t
        slab = _swinging_prism(left, right, low, high, back, face, pivot)
    else:
        face, back = front + _GAP + t, front + _GAP
        slab = rounded_box((left, low, back), (right, high, face), "z", p.corner, min(0.003, 0.2 * t))
        if p.plug:
            (x0, y0), (x1, y1), back = _opening(p)[0] + _GAP, _opening(p)[1] - _GAP, front - p.plug * t
            slab = union([slab, _swinging_prism(x0 + 0.004, x1, y0, y1, back, front + 2 * _GAP, pivot)])
    solids = [slab, *_fittings(p, left, right, face)]
    if p.bolt_work:
        solids += _bolt_work(p, pivot, front, back)
    x, _, z = pivot
    for bottom, top in _knuckles(p):
        middle = (bottom + top) / 2
        solids.append(cylinder(pivot, "y", bottom, middle - 2e-4, p.knuckle, segments=16))
        solids.append(_strap(p, x, z, bottom, middle - 2e-4, face))
    return union(solids)


def _strap(p: SafeParameters, x: float, z: float, low: float, high: float, face: float) -> Manifold:
    """From the knuckle to the slab: in front of the body for inset doors, in the middle of the slab for others."""
    if p.inset_door:
        end, top = p.door_low[0] + 0.014, face + 1.2 * p.knuckle
        root = box((p.door_low[0] + 0.004, low, face - OVERLAP), (end, high, top))
        return union([root, box((x, low, face + 2e-4), (end, high, top))])
    half = min(0.3 * p.slab, 0.6 * p.knuckle)
    root = box((p.door_low[0] + 0.004, low, face - 0.5 * p.slab), (p.door_low[0] + 0.012, high, z + half))
    arm = box((x, low, z - half), (p.door_low[0] + 0.012, high, z + half))
    return union([root, arm]) if z + half > face else arm


def _swinging_prism(
    left: float, right: float, low: float, high: float, back: float, face: float, pivot: np.ndarray
) -> Manifold:
    """Slab whose free edge is bevelled as far as it must be to swing clear of its frame about the pivot."""
    reach = right - pivot[0]
    free = pivot[0] + np.sqrt(reach**2 - (pivot[2] - back) ** 2)
    outline = polygon([(left, back), (free, back), (right, min(face, pivot[2])), (right, face), (left, face)])
    return extrude(outline, "y", low, high)


def _bolt_work(p: SafeParameters, pivot: np.ndarray, front: float, back: float) -> list[Manifold]:
    """Cover plate on the inner side of the door, and locking bolts drawn back into it."""
    low, high = _opening(p)
    width, height = high - low
    # As far as the free end of the bolts may reach without touching the frame on its way out.
    deepest = back - p.bolt_work - 0.002
    free = pivot[0] + np.sqrt((high[0] - pivot[0]) ** 2 - (pivot[2] - deepest) ** 2) - _GAP
    x0, x1 = low[0] + 0.14 * width, min(low[0] + 0.90 * width, free - 0.014)
    y0, y1 = low[1] + 0.12 * height, high[1] - 0.12 * height
    cover = rounded_box((x0, y0, back - p.bolt_work), (x1, y1, back + OVERLAP), "z", 0.008, 0.1 * p.bolt_work)
    if p.cover_slots:
        ys = np.linspace(y0 + 0.06 * (y1 - y0), y1 - 0.06 * (y1 - y0), 2 * p.cover_slots)
        far, floor = x1 - 0.03, back - 0.2 * p.bolt_work
        pairs = zip(ys[::2], ys[1::2], strict=True)
        slots = [box((x0 + 0.01, a, back - 2 * p.bolt_work), (far, b, floor)) for a, b in pairs]
        cover = subtract(cover, slots)
    radius = 0.45 * p.bolt_work
    bolts = [
        cylinder((0, y, back - 0.5 * p.bolt_work), "x", x1 - 0.02, x1 + 0.012, radius, segments=12)
        for y in np.linspace(y0 + 0.2 * (y1 - y0), y1 - 0.2 * (y1 - y0), p.bolts)
    ]
    return [cover, *bolts]


def _fittings(p: SafeParameters, left: float, right: float, face: float) -> list[Manifold]:
    """Lock and handle, as flat as the door asks for: one above the other on tall doors, side by side on flat ones."""
    span, h = right - left, p.door_span[1]
    scale = min(1.5, span / 0.26, h / 0.20)
    if _is_tall(p.height):
        lock, grip = (left + 0.54 * span, p.lock_height * h), (left + 0.60 * span, 0.34 * h)
    else:
        lock, grip = (left + 0.36 * span, 0.5 * h), (left + 0.74 * span, 0.5 * h)
    second = lock
    if p.keypad and p.dial:
        lock, second = (left + 0.30 * span, lock[1]), (left + 0.70 * span, lock[1])
    solids = [_handle(p, (*grip, 0.0), scale)]
    if p.keypad:
        solids += _keypad(lock, 0.0, scale)
    if p.dial:
        solids.append(_dial(second, 0.0, 0.03 * scale))
    whole = union(solids)
    flat = p.fittings / whole.bounding_box()[5]
    return [whole.scale((1.0, 1.0, flat)).translate((0.0, p.door_low[1], face))]


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
            center, "y", min(0.13, (0.26 if _is_tall(p.height) else 0.5) * p.door_span[1]), 0.035, r, square=True
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
