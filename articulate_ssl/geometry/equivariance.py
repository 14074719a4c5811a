"""Equivariance as a contract: say how a layer's inputs and outputs transform, and check that it does.

assert_equivariant(backbone, (points,), group, [Vector()], Permutation())
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import roma
import torch
from torch import Tensor

from articulate_ssl.geometry.rotation_group import RotationGroup
from articulate_ssl.geometry.se3 import se3, transform_points

TOLERANCE = {torch.float32: 1e-4, torch.float64: 1e-9}  # relative to the norm of the output


@dataclass(frozen=True)
class Permutation:
    """Features [..., G, C] of a left action: rotation by element a moves the feature at g to `product[a, g]`.

    Attributes:
        action: [G, V] for features [..., V, C] on something else that the group permutes (`Directions.action`).
    """

    action: Tensor | None = None

    def __call__(self, value: Tensor, group: RotationGroup, element: int) -> Tensor:
        table = group.product if self.action is None else self.action
        index = table[group.inverse[element]].to(value.device)  # the feature at h comes from a^{-1} h
        return value.index_select(-2, index)


@dataclass(frozen=True)
class Vector:
    """Points or directions [..., 3]."""

    def __call__(self, value: Tensor, group: RotationGroup, element: int) -> Tensor:
        return value @ group.elements[element].to(value).T


@dataclass(frozen=True)
class Invariant:
    """Anything that rotation leaves unchanged."""

    def __call__(self, value: Tensor, group: RotationGroup, element: int) -> Tensor:
        return value


Action = Permutation | Vector | Invariant


def assert_equivariant(
    layer: Callable[..., Tensor],
    inputs: Sequence[Tensor],
    group: RotationGroup,
    input_actions: Sequence[Action],
    output_action: Action,
    tolerance: float | None = None,
) -> None:
    """Check layer(action(inputs)) = action(layer(inputs)) for every element of the group.

    Args:
        tolerance: largest norm of the difference relative to the output's; by default that of the output's type.

    Raises:
        AssertionError: naming the worst element and its error.
    """
    expected = layer(*inputs)
    errors = []
    for element in range(len(group)):
        moved = layer(*(act(value, group, element) for act, value in zip(input_actions, inputs, strict=True)))
        errors.append(_relative_error(moved, output_action(expected, group, element)))
    _assert_small(errors, expected, tolerance, "not equivariant under group element")


def assert_part_equivariant(
    layer: Callable[[Tensor, Tensor], Tensor],
    points: Tensor,  # [B, N, 3]
    poses: Tensor,  # [B, N, 4, 4] of each point's part
    part_id: Tensor,  # [B, N] int64
    tolerance: float | None = None,
    num_motions: int = 3,
) -> None:
    """Check that a layer of (points, poses) ignores rigid motions of single parts whose poses move along.

    Every part moves by its own random rotation (any, not only the group's) and translation; features in the canonical
    frame must stay the same.

    Raises:
        AssertionError: naming the worst motion and its error.
    """
    expected = layer(points, poses)
    num_parts = int(part_id.max()) + 1
    generator = torch.Generator().manual_seed(0)
    errors = []
    for _ in range(num_motions):
        quaternion = torch.randn(num_parts, 4, dtype=torch.float64, generator=generator)
        rotation = roma.unitquat_to_rotmat(roma.quat_normalize(quaternion))
        translation = torch.randn(num_parts, 3, dtype=torch.float64, generator=generator)
        motion = se3(rotation, translation).to(points)[part_id]  # [B, N, 4, 4]
        moved = transform_points(motion, points[..., None, :]).squeeze(-2)
        errors.append(_relative_error(layer(moved, motion @ poses), expected))
    _assert_small(errors, expected, tolerance, "not part-level equivariant under motion")


def off_group_residual(
    layer: Callable[[Tensor], Tensor],
    points: Tensor,  # [B, N, 3]
    group: RotationGroup,
    num_rotations: int = 10,
) -> float:
    """Mean relative change of features [..., G, C] under random rotations, permuted by the nearest element.

    Equivariance is exact for the group only; this is what remains between its elements.
    """
    expected = layer(points)
    rotations = roma.random_rotmat(num_rotations, dtype=points.dtype, device=points.device)
    errors = [
        _relative_error(layer(points @ rotation.T), Permutation()(expected, group, int(group.nearest(rotation))))
        for rotation in rotations
    ]
    return sum(errors) / len(errors)


def _relative_error(value: Tensor, expected: Tensor) -> float:
    return ((value - expected).norm() / expected.norm()).item()


def _assert_small(errors: list[float], expected: Tensor, tolerance: float | None, what: str) -> None:
    if tolerance is None:
        tolerance = TOLERANCE[expected.dtype]
    worst = max(range(len(errors)), key=errors.__getitem__)
    if not errors[worst] <= tolerance:
        raise AssertionError(f"{what} {worst}: relative error {errors[worst]:.2e} > {tolerance:.0e}")
