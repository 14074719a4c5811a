"""Parts of many objects, each found on its own, under common names: those that lie at the same place of their object.

Where parts repeat, as drawers do, nothing but their place tells them apart. Objects stand alike, in unit boxes; each
takes the names that bring its parts nearest to where parts of that name lie in the median over all.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

_ROUNDS = 10  # at most; two or three are enough


class ObjectParts(NamedTuple):
    """Clouds of one object, and its parts in them.

    Attributes:
        boxes: [m, P, 3] the clouds, standing as all objects do, in unit boxes.
        label: [m, P] which of the object's parts every point belongs to, 0..K-1.
        root: The part that does not slide.
    """

    boxes: Tensor
    label: Tensor
    root: int

    def centers(self, num_parts: int) -> Tensor:  # [K, 3]
        """Mean place of every part's points."""
        points, label = self.boxes.flatten(0, 1), self.label.flatten()
        return torch.stack([points[label == part].mean(dim=0) for part in range(num_parts)])


def named_alike(
    objects: Sequence[ObjectParts],
    num_parts: int,
) -> list[Tensor]:  # of [K] which common part each of the object's own is
    """Common names for the parts of all objects, at first those that the first one has."""
    centers, root = [one.centers(num_parts) for one in objects], objects[0].root
    places, names = centers[0], []
    for _ in range(_ROUNDS):
        before = names
        names = [_named(own, one.root, places, root) for own, one in zip(centers, objects, strict=True)]
        if before and all(torch.equal(a, b) for a, b in zip(before, names, strict=True)):
            break
        places = (
            torch.stack([own[name.argsort()] for own, name in zip(centers, names, strict=True)]).median(dim=0).values
        )
    return names


def _named(
    centers: Tensor,  # [K, 3]
    root: int,
    places: Tensor,  # [K, 3]
    place_root: int,
) -> Tensor:  # [K]
    """Roots have one name, other parts what costs least in all."""
    own, common = ([part for part in range(len(places)) if part != one] for one in (root, place_root))
    cost = torch.cdist(centers[own], places[common])
    rows, columns = linear_sum_assignment(cost.double().cpu().numpy())
    name = torch.full((len(places),), place_root)
    name[torch.tensor(own)[rows]] = torch.tensor(common)[columns]
    return name
