"""Finite rotation groups as tables: the anchors of group-equivariant features."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import product

import torch
from torch import Tensor

_GOLDEN = (1 + 5**0.5) / 2

# Two rotation axes (any length) and turns that generate each group; axes are those of the solids in `vertices`.
_GENERATORS = {
    12: (((1.0, 1.0, 1.0), 3), ((0.0, 0.0, 1.0), 2)),
    24: (((1.0, 1.0, 1.0), 3), ((0.0, 0.0, 1.0), 4)),
    60: (((1.0, 1.0, 1.0), 3), ((0.0, 1.0, _GOLDEN), 5)),
}


@dataclass(frozen=True, eq=False)
class RotationGroup:
    """A finite subgroup of SO(3).

    Convention:
        `product[a, b]` is the index of `elements[a] @ elements[b]`; index arithmetic is not the group product. A left
        action by a sends feature index g to `product[a, g]`.

    Attributes:
        elements: [G, 3, 3] float64 rotation matrices, ordered by angle; the identity comes first.
        product: [G, G] int64.
        inverse: [G] int64.
        identity: index of the identity.
    """

    elements: Tensor
    product: Tensor
    inverse: Tensor
    identity: int

    def __len__(self) -> int:
        return self.elements.shape[0]

    def nearest(
        self,
        rotation: Tensor,  # [..., 3, 3]
    ) -> Tensor:  # [...] int64
        """Index of the element at the smallest geodesic angle from each rotation."""
        elements = self.elements.to(rotation)
        return torch.einsum("...ij,gij->...g", rotation, elements).argmax(dim=-1)


@cache
def rotation_group(order: int) -> RotationGroup:
    """The tetrahedral (12), octahedral (24) or icosahedral (60) rotation group.

    The tetrahedral group is a subgroup of the two others, in the same orientation.

    Raises:
        ValueError: for any other order.
    """
    if order not in _GENERATORS:
        raise ValueError(f"the order of a rotation group must be one of {sorted(_GENERATORS)}, got {order}")
    elements = _closure([_axis_turn(axis, fold) for axis, fold in _GENERATORS[order]])
    products = torch.einsum("aij,bjk->abik", elements, elements)
    table = torch.einsum("abij,gij->abg", products, elements).argmax(dim=-1)
    identity = int(torch.einsum("gii->g", elements).argmax())
    inverse = (table == identity).int().argmax(dim=1)
    return RotationGroup(elements=elements, product=table, inverse=inverse, identity=identity)


def _axis_turn(axis: tuple[float, float, float], fold: int) -> Tensor:
    """Rotation by 2 pi / fold about an axis (Rodrigues' formula)."""
    x, y, z = torch.nn.functional.normalize(torch.tensor(axis, dtype=torch.float64), dim=0).tolist()
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    angle = torch.tensor(2 * torch.pi / fold, dtype=torch.float64)
    return torch.eye(3, dtype=torch.float64) + angle.sin() * cross + (1 - angle.cos()) * cross @ cross


def _closure(generators: list[Tensor]) -> Tensor:
    """All products of the generators, with entries snapped to their exact values."""
    found = [torch.eye(3, dtype=torch.float64)]
    for element in found:
        for generator in generators:
            candidate = _snap(generator @ element)
            if all((candidate - other).abs().max() > 1e-6 for other in found):
                found.append(candidate)
    elements = torch.stack(found)
    # A stable order that does not depend on how the group was generated: by angle, then entry by entry.
    keys = torch.cat([-torch.einsum("gii->g", elements)[:, None], elements.flatten(1)], dim=1).mul(1e6).round().tolist()
    return elements[torch.tensor(sorted(range(len(found)), key=keys.__getitem__))]


# Every entry of these groups' matrices in this orientation, from the coordinates of the solids.
_ENTRIES = torch.tensor(
    sorted({s * v for s, v in product((-1, 1), (0.0, 1.0, 0.5, _GOLDEN / 2, (_GOLDEN - 1) / 2))}), dtype=torch.float64
)


def _snap(rotation: Tensor) -> Tensor:
    return _ENTRIES[(rotation[..., None] - _ENTRIES).abs().argmin(dim=-1)]
