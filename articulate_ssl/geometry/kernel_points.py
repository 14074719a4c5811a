"""Kernel points closed under the rotation group, so that a group element only permutes them."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor

from articulate_ssl.geometry.rotation_group import RotationGroup

_GOLDEN = (1 + 5**0.5) / 2
_SIGNS = (-1.0, 1.0)


class KernelPoints(NamedTuple):
    """Kernel points at unit scale (the farthest has norm 1; a layer scales them by 0.7 times its radius).

    Attributes:
        points: [K, 3] float64.
        permutation: [G, K] int64 with `elements[g] @ points[k] == points[permutation[g, k]]`.
    """

    points: Tensor
    permutation: Tensor


def _cyclic(*points: tuple[float, float, float]) -> Tensor:
    """Unit vectors along the points and their cyclic coordinate permutations."""
    turned = {p[i:] + p[:i] for p in points for i in range(3)}
    return torch.nn.functional.normalize(torch.tensor(sorted(turned), dtype=torch.float64), dim=-1)


_CENTRE = torch.zeros(1, 3, dtype=torch.float64)
_OCTAHEDRON = _cyclic(*((0.0, 0.0, s) for s in _SIGNS))
_CUBE = _cyclic(*product(_SIGNS, repeat=3))
_CUBOCTAHEDRON = _cyclic(*((0.0, a, b) for a, b in product(_SIGNS, repeat=2)))
_ICOSAHEDRON = _cyclic(*((0.0, a, b * _GOLDEN) for a, b in product(_SIGNS, repeat=2)))
_DODECAHEDRON = torch.cat([_CUBE, _cyclic(*((0.0, a * _GOLDEN, b / _GOLDEN) for a, b in product(_SIGNS, repeat=2)))])

# The inner of two shells sits at half the radius, midway between the centre and the outer shell.
_ICOSAHEDRAL = {
    12: (_ICOSAHEDRON,),
    13: (_CENTRE, _ICOSAHEDRON),
    24: (0.5 * _ICOSAHEDRON, _ICOSAHEDRON),
    25: (_CENTRE, 0.5 * _ICOSAHEDRON, _ICOSAHEDRON),
    32: (_ICOSAHEDRON, _DODECAHEDRON),
    33: (_CENTRE, _ICOSAHEDRON, _DODECAHEDRON),
}
_OCTAHEDRAL = {
    12: (_CUBOCTAHEDRON,),
    13: (_CENTRE, _CUBOCTAHEDRON),
    15: (_CENTRE, _OCTAHEDRON, _CUBE),
    24: (0.5 * _CUBOCTAHEDRON, _CUBOCTAHEDRON),
    26: (_OCTAHEDRON, _CUBE, _CUBOCTAHEDRON),
    27: (_CENTRE, _OCTAHEDRON, _CUBE, _CUBOCTAHEDRON),
}
# The tetrahedral group is contained in the icosahedral one, so the icosahedron's more even orbits serve it too.
_ORBITS = {12: _ICOSAHEDRAL, 24: _OCTAHEDRAL, 60: _ICOSAHEDRAL}


def symmetric_kernel_points(group: RotationGroup, num_points: int = 24) -> KernelPoints:
    """Union of orbits of the group with `num_points` points in all (the paper's count is 24).

    Raises:
        ValueError: if no union of the known orbits has that many points.
    """
    choices = _ORBITS[len(group)]
    if num_points not in choices:
        raise ValueError(
            f"no kernel of {num_points} points is closed under the group of order {len(group)}; "
            f"choose one of {sorted(choices)}"
        )
    points = torch.cat(choices[num_points])
    rotated = torch.einsum("gij,kj->gki", group.elements, points)
    distance = (rotated[:, :, None] - points).norm(dim=-1)  # [G, K, K]
    return KernelPoints(points, distance.argmin(dim=-1))
