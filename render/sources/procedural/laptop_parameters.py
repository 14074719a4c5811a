"""What laptops differ in, and how it is drawn: no single measure tells a base from a lid.

Either plate may be the thicker one; either may be plain, and either may carry relief. The hinge lies above the deck or
deep in the base, at its rear edge or far in front of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from render.sources.procedural.design import from_quantiles


@dataclass(frozen=True)
class Relief:
    """What the two plates show on their four large faces. Sizes in metres, 0 or empty where there is none.

    Attributes:
        bezel: Width of the frame around the screen.
        chin: Width of its lower edge.
        screen_depth: Of the screen behind the frame.
        logo: `none`, `bump`, `recess` or `hollow`: what the outer face of the lid shows.
        logo_height: Of the bump, or depth of the recess or hollow.
        logo_size: Share of the lid's width that a bump or recess takes.
        back_ribs: Ribs across a hollow lid or on a plain one.
        sunk_deck: Depth of the deck within the rim of the base.
        well: Depth of the keyboard's well below the deck.
        key_drop: How far key tops lie below the deck.
        key_rows: 0 for a flat deck.
        keys_per_row: In the main block.
        numpad: Whether there is a second block of keys.
        keyboard_width: Share of the base's width.
        keyboard_depth: Share of its depth.
        touchpad: Depth of its recess.
        touchpad_width: Share of the base's width.
        touchpad_depth: Share of its depth.
        speakers: Slots of the grille on either side of the keyboard.
        vents: Slots in the underside.
        underside_ribs: Ribs across a hollow underside, which is closed where there are none.
        ports: Side (-1 or 1), distance from the rear as a share of the depth, and width of every socket.
    """

    bezel: float
    chin: float
    screen_depth: float
    logo: str
    logo_height: float
    logo_size: float
    back_ribs: int
    sunk_deck: float
    well: float
    key_drop: float
    key_rows: int
    keys_per_row: int
    numpad: bool
    keyboard_width: float
    keyboard_depth: float
    touchpad: float
    touchpad_width: float
    touchpad_depth: float
    speakers: int
    vents: int
    underside_ribs: int
    ports: tuple[tuple[float, float, float], ...]


@dataclass(frozen=True)
class LaptopParameters:
    """Sizes in metres; y = 0 is the lower face of the base without its feet.

    Attributes:
        width: Of the base.
        depth: Of the base.
        slab: Thickness of the base without feet and side walls.
        foot_height: Of the feet.
        foot_strips: Whether the feet are strips across the base.
        wall_height: Of side walls, between which the lid lies; 0 for a lid as wide as the base.
        wall_width: Of one side wall.
        wall_length: Share of the depth that the walls take, from the rear.
        gap: Between the closed plates.
        lid: Thickness of the lid's panel.
        lid_depth: Of the lid, from behind its hinge.
        pivot: Height of the hinge line, and its distance in front of the rear of the base.
        rear: How far the lid reaches behind the hinge line.
        barrel: Radius of the lid's hinge barrels.
        barrel_ranges: Where the barrels are, as shares of the width from the middle.
        opening: Largest opening, degrees.
        corner: Radius of the outlines' corners.
        edge: Chamfer of their edges.
        taper: Share of the slab that is left at the front edge.
        relief: Of the faces.
    """

    width: float
    depth: float
    slab: float
    foot_height: float
    foot_strips: bool
    wall_height: float
    wall_width: float
    wall_length: float
    gap: float
    lid: float
    lid_depth: float
    pivot: tuple[float, float]
    rear: float
    barrel: float
    barrel_ranges: tuple[tuple[float, float], ...]
    opening: float
    corner: float
    edge: float
    taper: float
    relief: Relief

    @property
    def lid_width(self) -> float:
        """Of the lid, which has a little play between side walls."""
        return self.width - 2 * (self.wall_width + PLAY) if self.wall_height else self.width


@dataclass(frozen=True)
class _Build:
    """Vertical sizes of a laptop as shares of the height of the base's closed bounding box, and the hinge's place."""

    lid: float
    hinge_height: float
    foot_height: float
    wall_height: float
    barrel: float
    hinge_inset: float  # share of the depth

    @property
    def panel(self) -> float:
        """Thickness of the lid's panel: what is left of the lid's box above its barrels."""
        return self.lid - max(0.0, self.deck + _GAP_SHARE - self.hinge_height + self.barrel)

    @property
    def deck(self) -> float:
        """Height of the deck above the ground."""
        return 1.0 - self.wall_height

    @property
    def closed(self) -> float:
        """Height of the closed laptop."""
        return max(1.0, self.deck + _GAP_SHARE + self.panel)


_LARGEST_SAMPLED_DEG = 100.0  # the least that every lid opens: a little more than the category samples
_THINNEST_SHELL = 0.007  # metres of base below which ribs would not show
_SHELF = 0.05  # of the depth: what reaches farther behind the hinge is a shelf, and is not given up to the lid
PLAY = 0.0006  # between the lid and side walls
_GAP_SHARE = 0.035  # of the base's height, between the closed plates ...
_LEAST_GAP = 0.0004  # ... and at least so many metres, more than the clearance of what swings
_THINNEST_PANEL = 0.12  # of the base's height
_THICKEST_LID = 0.10  # of the diagonal of the base: beyond, thick lids on thick bases look like suitcases

# Minimum, quartiles and maximum of 43 CAD laptops, closed (findings of 2026-11-21, section 1).
_WIDTH_TO_DEPTH = (1.12, 1.31, 1.40, 1.48, 2.13)
_BASE_TO_DIAGONAL = (0.015, 0.033, 0.044, 0.065, 0.109)
_LID_TO_BASE = (0.28, 0.73, 0.96, 1.17, 2.0)
_HINGE_HEIGHT = (0.43, 0.65, 0.82, 0.95, 1.33)
_OPENING_DEG = (_LARGEST_SAMPLED_DEG, 106.0, 135.0, 168.0, 179.0)


def sample_laptop(rng: np.random.Generator) -> LaptopParameters:
    """Laptops of all ages and makes, with the proportions of CAD collections."""
    width = rng.uniform(0.26, 0.42)
    depth = width / from_quantiles(rng, *_WIDTH_TO_DEPTH)
    diagonal = float(np.hypot(width, depth))
    share = from_quantiles(rng, *_BASE_TO_DIAGONAL)
    lid = min(from_quantiles(rng, *_LID_TO_BASE), _THICKEST_LID / share)
    shape = _draw_build(rng, lid, from_quantiles(rng, *_HINGE_HEIGHT), walls=rng.random() < 0.2)
    height = share * diagonal / np.sqrt(1 - min(0.5, (share * shape.closed) ** 2))
    return _sample(rng, width, depth, float(height), shape, open_shells=0.2)


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
    """Laptops with the outer sizes of real products, within two per cent; their lids hold a display and no more."""
    width, depth, closed = np.array(_PRODUCTS[rng.integers(len(_PRODUCTS))]) * rng.uniform(0.98, 1.02, 3)
    lid, hinge_height = from_quantiles(rng, 0.28, 0.45, 0.6, 0.8, 1.1), from_quantiles(rng, 0.55, 0.75, 0.88, 1.0, 1.15)
    shape = _draw_build(rng, lid, hinge_height, walls=rng.random() < 0.1)
    return _sample(rng, width, depth, closed / shape.closed, shape, open_shells=0.0)


def _draw_build(rng: np.random.Generator, lid: float, hinge_height: float, walls: bool) -> _Build:
    """A hinge height that leaves the lid a panel: thin lids have no room for a hinge deep in the base."""
    inset = rng.uniform(_SHELF, 0.24) if rng.random() < 0.08 else from_quantiles(rng, 0.005, 0.012, 0.02, 0.028, 0.045)
    wall = rng.uniform(0.08, 0.4) if walls else 0.0
    deck = 1 - wall
    barrel = rng.uniform(0.07, 0.16)
    lowest = deck + _GAP_SHARE + barrel - lid + max(_THINNEST_PANEL, 0.25 * lid)
    if inset > _SHELF:  # a trough across the base must leave it whole
        lowest = max(lowest, 0.6 * deck)
    highest = deck + _GAP_SHARE + min(0.6 * lid, 0.33)
    height = float(np.clip(hinge_height, min(lowest, highest), highest))
    barrel = min(barrel, 0.45 * lid)
    shape = _Build(lid, height, rng.choice([0.0, 0.05, 0.1, 0.2]) * rng.uniform(0.7, 1.1), wall, barrel, inset)
    # Side walls end with the lid's upper face at most.
    return shape if shape.wall_height <= shape.panel + _GAP_SHARE else _draw_build(rng, lid, hinge_height, False)


def _sample(
    rng: np.random.Generator, width: float, depth: float, height: float, shape: _Build, open_shells: float
) -> LaptopParameters:
    """Sizes in metres of a laptop whose base is `height` high, feet and side walls included.

    `open_shells` is the share of lids, and of bases, that are shells with ribs, as light models of laptops often are.
    """
    boxy = rng.random() < 0.4
    foot = height * min(shape.foot_height, shape.hinge_height - 0.3)
    slab, lid = height * shape.deck - foot, height * shape.panel
    inset = depth * shape.hinge_inset
    shelf = inset > _SHELF * depth
    rear = rng.uniform(0.3, 1.0) * (height * shape.barrel if shelf else min(inset, 0.012))
    above = height * shape.hinge_height - foot
    edge = rng.uniform(0.0004, 0.0008) if boxy else rng.uniform(0.001, 0.004)
    return LaptopParameters(
        width=width,
        depth=depth,
        slab=slab,
        foot_height=foot,
        foot_strips=bool(rng.random() < 0.35),
        wall_height=height * shape.wall_height,
        wall_width=rng.uniform(0.004, 0.014),
        wall_length=float(rng.choice([1.0, rng.uniform(0.08, 0.3)])),
        gap=max(height * _GAP_SHARE, _LEAST_GAP),
        lid=lid,
        lid_depth=_draw_lid_depth(rng, depth, inset, rear, odd=0.06 if open_shells else 0.0),
        pivot=(above, inset),
        rear=rear,
        barrel=height * shape.barrel,
        barrel_ranges=_draw_barrels(rng),
        opening=_draw_opening(rng, shape, shelf),
        corner=rng.uniform(0.002, 0.005) if boxy else rng.uniform(0.008, 0.020),
        edge=min(edge, 0.22 * min(slab, lid)),
        taper=1.0 if boxy or rng.random() < 0.3 else rng.uniform(0.55, 1.0),
        relief=_draw_relief(rng, width, slab, lid, open_shells),
    )


def _draw_lid_depth(rng: np.random.Generator, depth: float, inset: float, rear: float, odd: float) -> float:
    """As deep as the base, but for hinges far in front of its rear.

    A share `odd` of the lids leaves a lip in front, and as many are larger than the base, as docked tablets are.
    """
    kind = rng.random()
    if inset > _SHELF * depth:
        return depth - inset + rear
    if kind < odd:
        return depth * rng.uniform(0.78, 0.97)
    if kind < 2 * odd:
        return depth * rng.uniform(1.03, 1.25)
    return depth * rng.normal(1.0, 0.006)


def _draw_barrels(rng: np.random.Generator) -> tuple[tuple[float, float], ...]:
    kind = rng.random()
    if kind < 0.4:
        half = rng.uniform(0.34, 0.49)
        return ((-half, half),)
    if kind < 0.5:
        half = rng.uniform(0.1, 0.25)
        return ((-half, half),)
    center, half = rng.uniform(0.25, 0.40), rng.uniform(0.02, 0.07)
    return tuple((side * center - half, side * center + half) for side in (-1, 1))


def _draw_opening(rng: np.random.Generator, shape: _Build, shelf: bool) -> float:
    """Degrees. What stands behind the hinge stops a lid that leans back: a quarter of the base must stay below it."""
    wanted = from_quantiles(rng, *_OPENING_DEG)
    if not shelf:
        return wanted
    reach = shape.deck + _GAP_SHARE + shape.panel - shape.hinge_height
    room = np.clip((shape.hinge_height - 0.3) / max(reach, 1e-6), 0.0, 0.9)
    return max(_LARGEST_SAMPLED_DEG, min(wanted, 90.0 + float(np.rad2deg(np.arcsin(room)))))


def _draw_relief(rng: np.random.Generator, width: float, slab: float, lid: float, open_shells: float) -> Relief:
    """Relief no deeper than the plates bear."""
    bezel = rng.uniform(0.004, 0.012) if rng.random() < 0.5 else rng.uniform(0.012, 0.035)
    keys = rng.random() < 0.94
    hollow_base = rng.random() < open_shells and slab > _THINNEST_SHELL
    keyboard_width = rng.uniform(0.74, 0.95)
    logo = "hollow" if rng.random() < open_shells else str(rng.choice(["none", "bump", "recess"], p=[0.5, 0.3, 0.2]))
    deep = rng.uniform(0.4, 0.7) * lid if logo == "hollow" else min(rng.uniform(0.0004, 0.002), 0.2 * lid)
    ribs = int(rng.integers(0, 24)) if logo == "hollow" else int(rng.random() < 0.08) * int(rng.integers(4, 12))
    return Relief(
        bezel=bezel,
        chin=bezel * rng.uniform(1.0, 2.2),
        screen_depth=min(rng.uniform(0.0004, 0.003), 0.25 * lid) if rng.random() < 0.85 else 0.0,
        logo=logo,
        logo_height=deep,
        logo_size=rng.uniform(0.05, 0.3),
        back_ribs=ribs,
        sunk_deck=min(rng.uniform(0.0005, 0.002), 0.12 * slab) if rng.random() < 0.2 else 0.0,
        well=min(from_quantiles(rng, 0.001, 0.0018, 0.003, 0.005), 0.3 * slab),
        key_drop=rng.choice([0.1, 0.3, 0.6]),
        key_rows=int(rng.integers(4, 7)) if keys else 0,
        keys_per_row=int(rng.integers(10, 16)),
        numpad=bool(keyboard_width * width > 0.31 and rng.random() < 0.6),
        keyboard_width=keyboard_width,
        keyboard_depth=rng.uniform(0.34, 0.47),
        touchpad=min(rng.uniform(0.0004, 0.0015), 0.1 * slab) if rng.random() < (0.85 if keys else 0.4) else 0.0,
        touchpad_width=rng.uniform(0.20, 0.45),
        touchpad_depth=rng.uniform(0.20, 0.32),
        speakers=int(rng.random() < 0.2) * int(rng.integers(4, 14)),
        vents=int(not hollow_base and rng.random() < 0.4) * int(rng.integers(4, 30)),
        underside_ribs=int(hollow_base) * int(from_quantiles(rng, 3, 12, 25, 40, 80)),
        ports=tuple(
            (side, 0.2 + 0.13 * place, rng.uniform(0.008, 0.016))
            for side in (-1.0, 1.0)
            for place in range(4)
            if rng.random() < 0.5
        ),
    )
