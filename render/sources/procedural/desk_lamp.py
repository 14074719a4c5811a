"""Desk lamps: a base, two arms and a head in a row, every one hinged to the one before; all hinges are parallel.

Each link begins with an eye and ends in a fork that holds the next link's eye, so that neighbours turn clear of each
other, and is made standing upright with its eye in the origin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from manifold3d import Manifold

from render.sources.procedural.design import Design, hinge
from render.sources.procedural.fittings import OVERLAP
from render.sources.procedural.shapes import box, cylinder, revolve, rounded_box, subtract, union

_PLAY = 6e-4  # between an eye and its fork
_LEAN_DEG = (
    40.0  # how far the lower arm leans back at coordinate 0; the upper arm and the head are then in line with it
)
_LARGEST_DEG = (60.0, 125.0, 95.0)  # of shoulder, elbow and wrist: beyond, a thick arm would meet the fork it turns in
_NAMES = ("shoulder", "elbow", "wrist")


@dataclass(frozen=True)
class DeskLampParameters:
    """Sizes in metres.

    Attributes:
        base: `disc`, `dome` or `plate`.
        base_radius: Half the width of the base.
        base_height: Of its plate or dome.
        post_height: From the base's upper face to the shoulder.
        shoulder: How far the shoulder lies behind the middle of the base.
        arms: Lengths of lower and upper arm between their hinges.
        thickness: Half the thickness of lower arm, upper arm and the head's neck.
        style: `square`, `round` or `twin`: two rods, one before the other.
        tine: Thickness of the tines of a fork.
        head: `cone`, `bell`, `drum`, `bar` or `cross_bar`.
        neck: From the wrist to the back of the head.
        head_length: Along the head's axis.
        head_radius: At the mouth of a shade; half the length of a bar across.
        back_radius: Of a shade's back; half the thickness of a bar.
        bulb: Radius of the bulb, 0 for a flat lamp.
    """

    base: str
    base_radius: float
    base_height: float
    post_height: float
    shoulder: float
    arms: tuple[float, float]
    thickness: tuple[float, float, float]
    style: str
    tine: float
    head: str
    neck: float
    head_length: float
    head_radius: float
    back_radius: float
    bulb: float


def sample(rng: np.random.Generator) -> DeskLampParameters:
    """Work lamps, reading lamps and light bars."""
    lower = rng.uniform(0.20, 0.42)
    upper = lower * rng.uniform(0.72, 1.25)
    thick = rng.uniform(0.008, 0.017)
    head = str(rng.choice(["cone", "bell", "drum", "bar", "cross_bar"], p=[0.28, 0.24, 0.18, 0.15, 0.15]))
    bar = head in ("bar", "cross_bar")
    eye = _eye_radius(thick)
    back = rng.uniform(0.006, 0.014) if bar else rng.uniform(0.014, 0.036)
    # Heads that fit the arms: longer ones would meet the base when the lamp is folded.
    size = min(lower, upper)
    length = size * {"bar": rng.uniform(0.4, 0.55), "cross_bar": rng.uniform(0.1, 0.2)}.get(
        head, rng.uniform(0.25, 0.5)
    )
    radius = rng.uniform(0.03, 0.07) if head == "drum" else size * rng.uniform(0.17, 0.30)
    if bar:
        radius = rng.uniform(0.014, 0.035) if head == "bar" else size * rng.uniform(0.35, 0.8)
    return DeskLampParameters(
        base=str(rng.choice(["disc", "dome", "plate"])),
        base_radius=rng.uniform(0.065, 0.13),
        base_height=rng.uniform(0.010, 0.035),
        post_height=rng.uniform(0.025, 0.11),
        shoulder=rng.uniform(0.0, 0.5),
        arms=(lower, upper),
        thickness=(thick, thick * rng.uniform(0.75, 1.0), thick * rng.uniform(0.6, 0.8)),
        style=str(rng.choice(["square", "round", "twin"])),
        tine=rng.uniform(0.002, 0.005),
        head=head,
        neck=1.5 * eye + rng.uniform(0.03, 0.12) * size + (0.0 if bar else 0.3 * back),
        head_length=length,
        head_radius=radius,
        back_radius=back,
        bulb=0.0 if bar else rng.uniform(0.35, 0.6) * min(radius, 0.05, 0.5 * length),
    )


def build(p: DeskLampParameters) -> Design:
    """Base, arms and head, with the lower arm leaning back and the rest in line with it."""
    shoulder = np.array([0.0, p.base_height + p.post_height, -p.shoulder * p.base_radius])
    upright = np.array([0.0, 1.0, 0.0])
    offsets = [0.0 * upright, p.arms[0] * upright, sum(p.arms) * upright]
    links = [_arm(p, 0), _arm(p, 1), _head(p)]
    lean = np.deg2rad(_LEAN_DEG)
    along = np.array([0.0, np.cos(lean), -np.sin(lean)])
    parts = {"base": _base(p, shoulder)}
    for name, solid, offset in zip(("lower_arm", "upper_arm", "head"), links, offsets, strict=True):
        parts[name] = solid.translate(tuple(offset)).rotate((-_LEAN_DEG, 0.0, 0.0)).translate(tuple(shoulder))
    joints = tuple(
        hinge(name, child, (1.0, 0.0, 0.0), shoulder + offset[1] * along, _LARGEST_DEG[child - 1], parent=child - 1)
        for child, (name, offset) in enumerate(zip(_NAMES, offsets, strict=True), start=1)
    )
    return Design(parts, joints)


def _eye_radius(thickness: float) -> float:
    return 1.35 * thickness


def _reach(p: DeskLampParameters, joint: int) -> float:
    """From a hinge to where the full thickness of the part before it may begin: two bars at an angle cross sooner."""
    return 2.9 * max(p.thickness[max(joint - 1, 0)], p.thickness[joint])


def _eye(thickness: float) -> Manifold:
    return cylinder((0.0, 0.0, 0.0), "x", -thickness, thickness, _eye_radius(thickness))


def _fork(p: DeskLampParameters, joint: int, own: float, pivot: float) -> Manifold:
    """Two tines around the eye of the next link at height `pivot`, on a block as thick as the bar below."""
    inner = p.thickness[joint] + _PLAY
    outer, radius, start = inner + p.tine, _eye_radius(p.thickness[joint]), pivot - _reach(p, joint)
    tines = []
    for low, high in ((-outer, -inner), (inner, outer)):
        eye = cylinder((0.0, pivot, 0.0), "x", low, high, radius)
        tines.append(Manifold.batch_hull([eye, box((low, start - own, -own), (high, start, own))]))
    return union([*tines, box((-outer, start - own, -own), (outer, start, own))])


def _bar(p: DeskLampParameters, half: float, low: float, high: float) -> list[Manifold]:
    """What lies between eye and fork."""
    if p.style == "square":
        return [box((-half, low, -half), (half, high, half))]
    if p.style == "round":
        return [cylinder((0.0, 0.0, 0.0), "y", low, high, half, segments=16)]
    rods = [cylinder((0.0, 0.0, z), "y", low, high, 0.36 * half, segments=12) for z in (-0.62 * half, 0.62 * half)]
    ends = [box((-half, y, -half), (half, y + half, half)) for y in (low, high - half)]
    return [*rods, *ends]


def _arm(p: DeskLampParameters, index: int) -> Manifold:
    """Arm with its eye in the origin and its fork at the next hinge."""
    half, length = p.thickness[index], p.arms[index]
    low, high = 0.7 * _eye_radius(half), length - _reach(p, index + 1)
    return union([_eye(half), *_bar(p, half, low, high), _fork(p, index + 1, half, length)])


def _base(p: DeskLampParameters, shoulder: np.ndarray) -> Manifold:
    r, h = p.base_radius, p.base_height
    if p.base == "plate":
        foot = rounded_box((-r, 0.0, -r), (r, h, r), "y", 0.25 * r, 0.1 * h)
    elif p.base == "disc":
        foot = revolve([(0, 0), (r, 0), (r, 0.8 * h), (0.97 * r, h), (0, h)], "y", 40)
    else:
        angle = np.linspace(0.0, np.pi / 2, 7)[:-1]
        arc = zip(r * np.cos(angle), h * np.sin(angle), strict=True)
        foot = revolve([(0, 0), *arc, (0, h)], "y", 40)
    own = p.thickness[0]
    fork = _fork(p, 0, own, 0.0).translate(tuple(shoulder))
    below = shoulder[1] - _reach(p, 0) - own + OVERLAP
    solids = [foot, fork]
    if below > 0.4 * h:
        solids.append(cylinder((0.0, 0.0, shoulder[2]), "y", 0.3 * h, below, 1.3 * own, segments=20))
    # A low shoulder's fork may reach through the base.
    return union(solids).trim_by_plane((0.0, 1.0, 0.0), 0.0)


def _head(p: DeskLampParameters) -> Manifold:
    """Neck with its eye in the origin, and a shade or a light bar."""
    half, start = p.thickness[2], p.neck
    end = start + p.head_length
    solids = [_eye(half), cylinder((0.0, 0.0, 0.0), "y", 0.6 * _eye_radius(half), start + 0.002, 0.9 * half)]
    if p.head in ("bar", "cross_bar"):
        w, t = p.head_radius, p.back_radius
        bar = rounded_box((-w, start, -t), (w, end, t), "z", 0.4 * min(w, p.head_length), 0.2 * t)
        margin = 0.25 * min(w, p.head_length)
        pane = rounded_box((-w + margin, start + margin, 0.7 * t), (w - margin, end - margin, 2 * t), "z", 0.2 * margin)
        return union([*solids, subtract(bar, [pane])])
    outside, wall = _shade_outline(p), 0.0025
    inside = [(max(radius - wall, 0.0), y) for radius, y in outside]
    shell = [(0.0, start), *outside, *reversed(inside[1:]), (inside[0][0], start + wall), (0.0, start + wall)]
    bulb_y = start + wall + 1.2 * p.bulb
    bulb = Manifold.sphere(min(p.bulb, 0.7 * p.back_radius + 0.01), 16).translate((0.0, bulb_y, 0.0))
    socket = cylinder((0.0, 0.0, 0.0), "y", start + 0.5 * wall, bulb_y, 0.4 * p.back_radius)
    return union([*solids, revolve(shell, "y", 32), socket, bulb])


def _shade_outline(p: DeskLampParameters) -> list[tuple[float, float]]:
    """Radius and height of a shade from its back to its mouth."""
    share = np.linspace(0.0, 1.0, 7)
    curve = {"cone": share, "bell": np.sin(share * np.pi / 2) ** 0.8, "drum": np.minimum(6 * share, 1.0)}[p.head]
    radius = p.back_radius + (p.head_radius - p.back_radius) * curve
    return list(zip(radius.tolist(), (p.neck + share * p.head_length).tolist(), strict=True))
