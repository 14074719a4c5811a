"""Eyeglasses: a frame with rims, bridge and end pieces, and two legs that bend down behind the ear and fold inwards."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from manifold3d import CrossSection, Manifold

from render.sources.procedural.design import Design, from_quantiles, hinge
from render.sources.procedural.shapes import box, cylinder, extrude, loft, subtract, union

_STRAIGHT = 1e3  # metres: radius of a front that is not curved
_FLATTEST_END = 0.0018  # metres; shorter end pieces would leave nothing between rim and barrels
_CLEARANCE = 2e-4  # between the moving pieces of a hinge


@dataclass(frozen=True)
class EyeglassesParameters:
    """Sizes in metres; the exponent, taper, lift and skew shape the lens outline (see `_lens_outline`)."""

    lens_width: float
    lens_height: float
    exponent: float
    taper: float
    lift: float
    skew: float
    bridge_width: float
    bridge_height: float
    bridge_arch: float
    bridge_radius: float
    double_bridge: bool
    rim_width: float
    rim_depth: float
    lenses: bool
    lower_rim: bool
    nose_pads: bool
    curve_radius: float
    hinge_height: float
    end_width: float
    end_depth: float
    leg_thickness: float
    leg_height: float
    leg_tip_height: float
    leg_length: float
    hook_share: float
    hook_angle: float
    leg_splay: float


# Lens outlines by frame shape: ranges of height / width, exponent, taper, lift and skew.
_FRAME_SHAPES = {
    "round": ((0.92, 1.0), (2.0, 2.1), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0)),
    "oval": ((0.62, 0.75), (2.1, 2.4), (0.0, 0.05), (0.0, 0.05), (0.0, 0.0)),
    "rectangular": ((0.52, 0.68), (4.0, 6.0), (0.0, 0.08), (0.0, 0.05), (0.0, 0.0)),
    "wayfarer": ((0.74, 0.86), (3.0, 3.8), (0.10, 0.18), (0.05, 0.12), (0.0, 0.05)),
    "aviator": ((0.80, 0.92), (2.4, 2.8), (0.12, 0.20), (0.0, 0.05), (0.12, 0.22)),
    "cat_eye": ((0.66, 0.82), (2.4, 3.0), (0.08, 0.15), (0.25, 0.40), (0.0, 0.05)),
}


def sample(rng: np.random.Generator) -> EyeglassesParameters:
    """Wire and acetate frames of six shapes."""
    shape = str(rng.choice(list(_FRAME_SHAPES)))
    aspect, exponent, taper, lift, skew = (rng.uniform(*interval) for interval in _FRAME_SHAPES[shape])
    wire = rng.random() < (0.7 if shape == "aviator" else 0.3)
    lens_width = rng.uniform(0.046, 0.058) if shape != "round" else rng.uniform(0.042, 0.050)
    lens_height = lens_width * aspect
    lenses = bool(rng.random() < 0.6)
    flat = rng.random() < 0.15  # as drawn from a photograph: a frame that is a plate, with the hinges right behind it
    rim_width = rng.uniform(0.0014, 0.0022) if wire else rng.uniform(0.003, 0.006)
    leg_height = rng.uniform(0.0028, 0.007) if wire else rng.uniform(0.007, 0.019)
    return EyeglassesParameters(
        lens_width=lens_width,
        lens_height=lens_height,
        exponent=exponent,
        taper=taper,
        lift=lift,
        skew=skew,
        bridge_width=rng.uniform(0.015, 0.022),
        bridge_height=rng.uniform(0.1, 0.45),
        bridge_arch=rng.uniform(0.001, 0.004),
        bridge_radius=rng.uniform(0.0011, 0.0016) if wire else rng.uniform(0.002, 0.003),
        double_bridge=bool(shape == "aviator" and rng.random() < 0.6),
        rim_width=rim_width,
        rim_depth=rng.uniform(0.0018, 0.0028) if wire or flat else rng.uniform(0.003, 0.0060),
        lenses=lenses,
        lower_rim=not (lenses and rng.random() < 0.15),
        nose_pads=bool(not flat and rng.random() < (0.9 if wire else 0.2)),
        curve_radius=_STRAIGHT if flat else rng.uniform(0.15, 0.60),
        hinge_height=rng.uniform(0.45, 0.7) if shape != "round" else rng.uniform(0.0, 0.45),
        end_width=rng.uniform(0.004, 0.009),
        end_depth=_FLATTEST_END if flat else from_quantiles(rng, _FLATTEST_END, 0.004, 0.007, 0.010, 0.013),
        leg_thickness=rng.uniform(0.0016, 0.0030) if wire else rng.uniform(0.0028, 0.0060),
        leg_height=leg_height,
        leg_tip_height=rng.uniform(0.004, 0.009) if wire else leg_height * rng.uniform(0.5, 1.0),
        leg_length=rng.uniform(0.120, 0.155),
        hook_share=rng.uniform(0.24, 0.36),
        hook_angle=np.deg2rad(rng.uniform(8.0, 55.0)),
        leg_splay=rng.uniform(-0.006, 0.004),
    )


def build(p: EyeglassesParameters) -> Design:
    """Frame and unfolded legs. Left is -x."""
    outline = _lens_outline(p)
    center = p.bridge_width / 2 + p.rim_width + p.lens_width / 2
    rim = CrossSection([outline]).offset(p.rim_width, circular_segments=24)
    attach, pivot = _hinge_points(p, rim, center)
    # The right-hand side is made, the left-hand side mirrored.
    end, leg = _end_piece(p, attach, pivot), _leg(p, pivot)
    frame = union([_front(p, outline, rim, center), end, _mirrored(end)])
    mirrored_pivot = pivot * (-1.0, 1.0, 1.0)
    return Design(
        parts={"frame": frame, "left_leg": _mirrored(leg), "right_leg": leg},
        joints=(
            hinge("left_hinge", 1, (0.0, -1.0, 0.0), mirrored_pivot, upper_deg=90.0),
            hinge("right_hinge", 2, (0.0, 1.0, 0.0), pivot, upper_deg=90.0),
        ),
    )


def _mirrored(solid: Manifold) -> Manifold:
    return solid.mirror((1.0, 0.0, 0.0))


def _lens_outline(p: EyeglassesParameters) -> np.ndarray:  # [M, 2]
    """Superellipse of the right lens about its own centre; +x is the temple side.

    It is `taper` wider at the top than in the middle, its upper temple corner is raised by `lift` half-heights, and its
    lower end is shifted outwards by `skew` half-widths.
    """
    angle = np.linspace(0.0, 2 * np.pi, 48, endpoint=False)
    u, v = (np.sign(f) * np.abs(f) ** (2 / p.exponent) for f in (np.cos(angle), np.sin(angle)))
    x = u * (1 + p.taper * v) / (1 + p.taper) + p.skew * np.square((1 - v) / 2)
    y = v + p.lift * (1 + v) / 2 * np.square((1 + u) / 2)
    return np.stack([0.5 * p.lens_width * x, 0.5 * p.lens_height * y], axis=-1)


def _curved(p: EyeglassesParameters, x: float | np.ndarray) -> float | np.ndarray:
    """z of the curved front at a horizontal position."""
    return -np.square(x) / (2 * p.curve_radius)


def _hinge_points(p: EyeglassesParameters, rim: CrossSection, center: float) -> tuple[np.ndarray, np.ndarray]:
    """Where the end piece leaves the right rim, and the hinge's pivot."""
    y = 0.5 * p.lens_height * p.hinge_height
    x = center + _horizontal_extent(rim, y)[1]
    attach = np.array([x, y, _curved(p, x)])
    return attach, attach + np.array([p.end_width, 0.0, -p.end_depth - 0.5 * p.rim_depth])


def _horizontal_extent(rim: CrossSection, y: float) -> tuple[float, float]:
    """Smallest and largest x of a rim at a height."""
    bounds = (rim ^ CrossSection.square((1.0, 2e-3), center=True).translate((0.0, y))).bounds()
    return bounds[0], bounds[2]


def _front(p: EyeglassesParameters, outline: np.ndarray, rim: CrossSection, center: float) -> Manifold:
    """Rims, lenses, bridge and nose pads, bent around the face."""
    half = 0.5 * p.rim_depth
    ring = extrude(rim - CrossSection([outline]), "z", -half, half)
    if not p.lower_rim:
        ring = ring.trim_by_plane((0.0, 1.0, 0.0), -0.12 * p.lens_height)
    pieces = [ring]
    if p.lenses:
        glass = min(0.0018, 0.8 * p.rim_depth)
        pieces.append(extrude(CrossSection([outline]).offset(2e-4), "z", -glass / 2, glass / 2))
    if p.nose_pads:
        pieces.append(_nose_pad(p, rim))
    side = union(pieces).translate((center, 0.0, 0.0))
    front = union([side, _mirrored(side), *_bridges(p, rim, center)])
    lengthy = front.refine_to_length(0.012)

    def bend(vertices: np.ndarray) -> np.ndarray:
        return vertices + np.stack([0 * vertices[:, 0], 0 * vertices[:, 0], _curved(p, vertices[:, 0])], axis=-1)

    return lengthy.warp_batch(bend)


def _bridges(p: EyeglassesParameters, rim: CrossSection, center: float) -> list[Manifold]:
    heights = [p.bridge_height * 0.5 * p.lens_height]
    if p.double_bridge:
        heights.append(0.46 * p.lens_height)
    bridges = []
    for y in heights:
        reach = center + _horizontal_extent(rim, y)[0] + 0.5 * p.rim_width
        x = np.linspace(-reach, reach, 9)
        arch = y + p.bridge_arch * (1 - np.square(x / reach))
        bridges.append(_rod(np.stack([x, arch, 0 * x], axis=-1), p.bridge_radius))
    return bridges


def _rod(path: np.ndarray, radius: float) -> Manifold:
    """Round rod along a path [S, 3] that runs mainly towards +x, with rings parallel to the y-z plane."""
    angle = np.linspace(0.0, 2 * np.pi, 10, endpoint=False)
    ring = radius * np.stack([0 * angle, np.cos(angle), np.sin(angle)], axis=-1)
    return loft(path[:, None] + ring)


def _nose_pad(p: EyeglassesParameters, rim: CrossSection) -> Manifold:
    """Pad and its arm, on the nose side of a lens that is centred at the origin."""
    y = -0.08 * p.lens_height
    x = _horizontal_extent(rim, y)[0] + 0.5 * p.rim_width
    pad = Manifold.sphere(1.0, 12).scale((0.0014, 0.0062, 0.0036)).rotate((0.0, 28.0, -12.0))
    pad = pad.translate((x - 0.002, y - 0.002, -0.0085))
    arm = Manifold.batch_hull(
        [Manifold.sphere(0.0009, 8).translate((x + dx, y, z)) for dx, z in ((0.0, 0.0), (-0.002, -0.0085))]
    )
    return union([pad, arm])


def _barrel_halves(p: EyeglassesParameters) -> tuple[float, float, float]:
    """Radius of the hinge barrel, and half-heights of its middle piece (the leg's) and of the whole."""
    whole = max(0.0024, 0.36 * p.leg_height)
    return 0.0013 + 0.1 * p.leg_thickness, 0.38 * whole, whole


def _end_piece(p: EyeglassesParameters, attach: np.ndarray, pivot: np.ndarray) -> Manifold:
    """From the rim to the hinge, with the two outer barrels."""
    half, t = 0.5 * p.leg_height, p.leg_thickness
    x, y, z = attach
    depth = 0.5 * p.rim_depth
    root_half = min(half, 0.0035)
    root = box((x - 0.6 * p.rim_width, y - root_half, z - depth), (x, y + root_half, z + depth))
    low_x, high_x = pivot[0] - 0.0008, pivot[0] + t
    corner = box((low_x, y - half, z - depth), (high_x, y + half, z + 0.6 * depth))
    back = box((low_x, y - half, pivot[2] + _CLEARANCE), (high_x, y + half, z))
    radius, middle, whole = _barrel_halves(p)
    cut = cylinder(pivot, "y", y - middle - _CLEARANCE, y + middle + _CLEARANCE, radius + _CLEARANCE, segments=16)
    arm = union([Manifold.batch_hull([root, corner]), Manifold.batch_hull([corner, back])])
    spans = ((y - whole, y - middle - _CLEARANCE), (y + middle + _CLEARANCE, y + whole))
    barrels = [cylinder(pivot, "y", low, high, radius, segments=16) for low, high in spans]
    return union([subtract(arm, [cut]), *barrels])


def _leg(p: EyeglassesParameters, pivot: np.ndarray) -> Manifold:
    """Right leg: straight to above the ear, then bent down, with the hinge's middle barrel."""
    straight, hook = p.leg_length * (1 - p.hook_share), p.leg_length * p.hook_share
    lengths = np.concatenate([np.linspace(_CLEARANCE, straight, 4), straight + hook * np.linspace(0.0, 1.0, 8)[1:]])
    bent = np.clip((lengths - straight) / (0.45 * hook), 0.0, 1.0) * p.hook_angle
    steps, mean_bent = np.diff(lengths), (bent[1:] + bent[:-1]) / 2
    y = np.concatenate([[0.0], -np.cumsum(steps * np.sin(mean_bent))])
    back = _CLEARANCE + np.concatenate([[0.0], np.cumsum(steps * np.cos(mean_bent))])
    share = lengths / p.leg_length
    x = 0.5 * p.leg_thickness + p.leg_splay * np.square(share)
    root, tip = p.leg_height, p.leg_tip_height
    stations = [0.0, 0.12, 1 - p.hook_share, 0.85, 1.0]
    half_height = 0.5 * np.interp(share, stations, [root, 0.85 * root, 0.7 * root, tip, 0.7 * tip])
    half_thickness = 0.5 * p.leg_thickness * np.interp(share, [0.0, 0.7, 0.9, 1.0], [1.0, 0.8, 0.9, 0.6])
    # Octagonal section across the path, counter-clockwise seen from the tip.
    octagon = np.array([(1, -0.5), (1, 0.5), (0.5, 1), (-0.5, 1), (-1, 0.5), (-1, -0.5), (-0.5, -1), (0.5, -1)])[::-1]
    across = octagon[None, :, 0] * half_thickness[:, None]
    along = octagon[None, :, 1] * half_height[:, None]
    rings = np.stack(
        [
            x[:, None] + across,
            y[:, None] + along * np.cos(bent)[:, None],
            -back[:, None] - along * np.sin(bent)[:, None],
        ],
        axis=-1,
    )
    radius, middle, whole = _barrel_halves(p)
    height = pivot[1]
    cuts = [
        cylinder(pivot, "y", height + low, height + high, radius + _CLEARANCE, segments=16)
        for low, high in ((-whole - _CLEARANCE, -middle), (middle, whole + _CLEARANCE))
    ]
    inner = middle - _CLEARANCE
    barrel = cylinder(pivot, "y", height - inner, height + inner, radius, segments=16)
    return union([subtract(loft(rings + pivot), cuts), barrel])
