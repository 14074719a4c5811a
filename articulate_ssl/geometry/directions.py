"""Features on directions instead of rotations: twelve points of the sphere that the icosahedral group permutes."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from articulate_ssl.geometry.kernel_points import KernelPoints, symmetric_kernel_points
from articulate_ssl.geometry.rotation_group import RotationGroup


class Directions(NamedTuple):
    """The vertices of the icosahedron.

    A rotation by element a of the icosahedral group moves the feature at direction v to `action[a, v]`. Five elements
    leave a direction where it is; what they tell apart, all twelve directions together tell apart.

    Attributes:
        vectors: [V, 3] unit, float64.
        action: [G, V] int64 with `elements[g] @ vectors[v] == vectors[action[g, v]]`.
    """

    vectors: Tensor
    action: Tensor


def icosahedron_directions(group: RotationGroup) -> Directions:
    """The 12 directions.

    Raises:
        ValueError: for another group than the icosahedral one.
    """
    if len(group) != 60:
        raise ValueError(f"features on directions need the rotation group of order 60, got order {len(group)}")
    return Directions(*symmetric_kernel_points(group, 12))


def kernel_orbits(directions: Directions, kernel: KernelPoints) -> Tensor:
    """[V, K, V] int64: the orbits under the group of triples of direction, kernel point and neighbour's direction.

    A convolution kernel is equivariant if and only if it is constant on each.
    """
    V, K = len(directions.vectors), len(kernel.points)
    action, permutation = directions.action, kernel.permutation
    images = (action[:, :, None, None] * K + permutation[:, None, :, None]) * V + action[:, None, None, :]
    return images.amin(dim=0).flatten().unique(return_inverse=True)[1].view(V, K, V)


def kernel_rings(directions: Directions, kernel: KernelPoints) -> Tensor:
    """[V, K] int64: the same for pairs of direction and kernel point, all that a constant input sees."""
    K = len(kernel.points)
    images = directions.action[:, :, None] * K + kernel.permutation[:, None, :]
    return images.amin(dim=0).unique(return_inverse=True)[1]
