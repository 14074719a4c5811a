"""NSD (Kawana, Mukuta and Harada 2020, "Neural Star Domain as Primitive Representation"): star-shaped primitives.

A primitive is a centre t and a radius for every direction, r(d); it is known both ways: x is inside if
G(x) = 1 - |x - t| / r(direction of x - t) is positive, and its surface is t + r(d) d. Radii are expanded in spherical
harmonics, whose coefficients come from the shape's code. The shape is the union. Three losses, with their weights:

- occupancy: binary cross entropy of the union's indicator, here sigmoid(sharpness max G);
- surface: Chamfer distance between the cloud and those surface points of primitives that lie in no other primitive;
- overlap: mean of relu(sum of sigmoid(100 G) - 1.2), so that parts do not lie in each other.

A point belongs to the primitive of largest G. Primitives have the same number in every shape, as convexes of BSP-Net
have; the paper adopts the same evaluation for both (`PrimitiveMethod`, which says what it costs in labels).

As theirs: ten primitives, the indicator, the losses and their weights, the threshold against overlap. Otherwise: the
code comes from the cloud (`implicit.py`); radii are a truncated expansion in spherical harmonics alone (they refine by
a network); on partial views the surface is drawn to what is seen of it.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, softplus

from articulate_ssl.baselines.implicit import COORDINATES, SLOPE, CloudEncoder, PrimitiveMethod, draw_samples
from articulate_ssl.baselines.method import Effort, Problem
from articulate_ssl.ops.chamfer import nearest_index

CODE = 256  # theirs
PRIMITIVES = 10  # theirs
DEGREE = 6  # of the spherical harmonics; 49 of them. Chosen without a measurement
DIRECTIONS = 64  # in which a primitive's surface is sampled; theirs 400
SHARPNESS, OVERLAP_SHARPNESS = 10.0, 100.0  # theirs 100 in both; with 10, far primitives still have a gradient
SURFACE_WEIGHT, OVERLAP_WEIGHT, OVERLAP_THRESHOLD = 10.0, 10.0, 1.2  # theirs
INITIAL_RADIUS, INITIAL_SPREAD = 0.1, 0.2  # of primitives and their centres, in diagonals. Chosen without a measurement
_TINY = 1e-6


def spherical_harmonics(
    direction: Tensor,  # [..., 3] unit
    degree: int,
) -> Tensor:  # [..., (degree + 1)^2]
    """Real orthonormal spherical harmonics in the order l = 0..degree, m = -l..l; polynomials, smooth at the poles.

    By the recurrence of associated Legendre functions, divided by sin(theta)^m, which goes into the powers of x + i y.
    """
    x, y, z = direction.unbind(-1)
    cosine, sine = [torch.ones_like(x)], [torch.zeros_like(x)]  # of (x + i y)^m
    for _ in range(degree):
        cosine, sine = [*cosine, x * cosine[-1] - y * sine[-1]], [*sine, x * sine[-1] + y * cosine[-1]]
    values: dict[tuple[int, int], Tensor] = {}
    for m in range(degree + 1):
        legendre = [torch.full_like(z, float(math.prod(range(1, 2 * m, 2))))]  # P_m^m = (2m - 1)!!
        for level in range(m + 1, degree + 1):
            before = legendre[-2] * (level + m - 1) if level > m + 1 else 0.0
            legendre.append(((2 * level - 1) * z * legendre[-1] - before) / (level - m))
        for level, value in enumerate(legendre, start=m):
            ratio = math.factorial(level - m) / math.factorial(level + m)
            scale = math.sqrt((2 * level + 1) / (4 * math.pi) * ratio * (1 if m == 0 else 2))
            values[level, m] = scale * value * cosine[m]
            values[level, -m] = scale * value * (sine[m] if m else cosine[0])
    return torch.stack([values[level, m] for level in range(degree + 1) for m in range(-level, level + 1)], dim=-1)


def sphere_directions(count: int) -> Tensor:  # [count, 3]
    """Nearly even unit directions (Fibonacci)."""
    k = torch.arange(count)
    z = 1 - (2 * k + 1) / count
    angle = math.pi * (3 - math.sqrt(5)) * k
    radius = (1 - z * z).sqrt()
    return torch.stack([radius * angle.cos(), radius * angle.sin(), z], dim=-1)


class NSD(PrimitiveMethod):
    """Star domains as parts.

    Args:
        problem: What is known of the category.
    """

    title = "NSD"
    effort = Effort(steps=1500, batch_size=16, learning_rate=1e-3)

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem, PRIMITIVES)
        self.encoder = CloudEncoder(CODE)
        coefficients = (DEGREE + 1) ** 2
        self.primitives = nn.Sequential(
            nn.LeakyReLU(SLOPE),
            nn.Linear(CODE, CODE),
            nn.LeakyReLU(SLOPE),
            nn.Linear(CODE, PRIMITIVES * (3 + coefficients)),
        )
        direction = sphere_directions(DIRECTIONS)
        self.register_buffer("direction", direction, persistent=False)
        self.register_buffer("harmonics", spherical_harmonics(direction, DEGREE), persistent=False)
        # Spheres of the initial radius, spread out: the inverse of softplus over the constant harmonic.
        with torch.no_grad():
            last = self.primitives[-1]
            last.weight *= 0.1
            bias = torch.zeros(PRIMITIVES, 3 + coefficients)
            bias[:, :3] = INITIAL_SPREAD * sphere_directions(PRIMITIVES)
            bias[:, 3] = math.log(math.expm1(INITIAL_RADIUS)) * math.sqrt(4 * math.pi)
            last.bias.copy_(bias.flatten())

    def stars(
        self,
        cloud: Tensor,  # [B, N, 3]
    ) -> tuple[Tensor, Tensor]:  # [B, P, 3], [B, P, (degree + 1)^2]
        """Centres and radius coefficients of every cloud's primitives."""
        parameters = self.primitives(self.encoder(cloud)).view(len(cloud), PRIMITIVES, -1)
        return parameters[..., :3], parameters[..., 3:]

    def indicator(
        self,
        stars: tuple[Tensor, Tensor],
        points: Tensor,  # [B, M, 3]
    ) -> Tensor:  # [B, M, P]
        """G of every primitive: 1 at its centre, 0 at its surface, negative outside."""
        center, coefficient = stars
        offset = points[:, :, None] - center[:, None]  # [B, M, P, 3]
        length = (offset.square().sum(-1) + _TINY**2).sqrt()
        harmonics = spherical_harmonics(offset / length[..., None], DEGREE)
        return 1 - length / _radius(harmonics, coefficient[:, None])

    def surface(
        self,
        stars: tuple[Tensor, Tensor],
    ) -> tuple[Tensor, Tensor]:  # [B, P D, 3], [B, P D] bool
        """Points of all primitives' surfaces, and which of them lie in another primitive."""
        center, coefficient = stars
        radius = _radius(self.harmonics, coefficient[:, :, None])  # [B, P, D]
        points = center[:, :, None] + radius[..., None] * self.direction  # [B, P, D, 3]
        with torch.no_grad():
            within = self.indicator(stars, points.flatten(1, 2)).view(*radius.shape, PRIMITIVES) > 0  # [B, P, D, P]
            own = torch.eye(PRIMITIVES, dtype=torch.bool, device=within.device)[:, None]
            hidden = (within & ~own).any(-1)
        return points.flatten(1, 2), hidden.flatten(1)

    def training_step(self, batch: dict[str, Tensor], batch_idx: int) -> Tensor:
        """Sum of the three losses."""
        points, occupancy = draw_samples(batch)
        stars = self.stars(batch["points"])
        indicator = self.indicator(stars, points)
        inside = binary_cross_entropy_with_logits(SHARPNESS * indicator.amax(-1), occupancy)
        overlap = ((OVERLAP_SHARPNESS * indicator).sigmoid().sum(-1) - OVERLAP_THRESHOLD).relu().mean()
        surface = surface_loss(*self.surface(stars), batch["points"])
        return inside + SURFACE_WEIGHT * surface + OVERLAP_WEIGHT * overlap

    def primitive_of(
        self,
        points: Tensor,  # [B, N, 3]
    ) -> Tensor:  # [B, N] int64
        """The primitive in which a point lies deepest."""
        return self.indicator(self.stars(points), points).argmax(-1)


def surface_loss(
    surface: Tensor,  # [B, S, 3]
    hidden: Tensor,  # [B, S] bool
    cloud: Tensor,  # [B, N, 3]
) -> Tensor:
    """Squared Chamfer distance between clouds and the surface points that are not hidden, in NSD's coordinates."""

    def square(query: Tensor, target: Tensor, excluded: Tensor | None = None) -> Tensor:
        index = nearest_index(query.detach(), target.detach(), excluded)
        return (query - target.gather(1, index[..., None].expand_as(query))).square().sum(-1)

    seen = (~hidden).to(surface.dtype)
    to_cloud = (square(surface, cloud) * seen).sum(1) / seen.sum(1).clamp(min=1)
    return COORDINATES**2 * (to_cloud + square(cloud, surface, hidden).mean(1)).mean()


def _radius(harmonics: Tensor, coefficient: Tensor) -> Tensor:
    """Radii in directions whose harmonics are given; both [..., (degree + 1)^2], broadcasting."""
    return softplus((harmonics * coefficient).sum(-1)) + _TINY
