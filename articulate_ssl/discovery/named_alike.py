"""Parts of many objects, each found on its own, under common names: in the order in which one reads them.

Where parts repeat, as drawers do, nothing but their place tells them apart, and no place is common to all: three
drawers of a chest lie above each other, those of a desk beside each other, or around a corner. But all repeat along a
line, bent or not, so that the shortest path through them says which is next to which. From which end it is read, the
direction says in which most paths run; and of paths that are level in it, the direction that lies as what one reads
lies to the order of lines, seen from where parts slide to: if down is first, from left to right, and the other way
round together. By place in the median over all objects, which was tried before, every row of drawers was named in
another order than the generator names it (docs/experiments.md, step 178).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

# Of the cosine of a path's ends to the direction of most: of 200 chests and desks those of rows had .04 at most, of
# what goes around a corner .26 and more.
_LEVEL = 0.15
_EDGE = 0.02  # share of a part's points that are left out where it ends


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
    """Common names for the parts of all objects: 0 for what does not slide, then in order."""
    outwards = _outwards(objects)
    across = torch.eye(3).to(outwards) - outwards[:, None] * outwards
    slides = [torch.tensor([part for part in range(num_parts) if part != one.root]) for one in objects]
    places = [one.centers(num_parts)[own] @ across for one, own in zip(objects, slides, strict=True)]
    paths = [_shortest_path(own) for own in places]
    ends = torch.stack([own[path[-1]] - own[path[0]] for own, path in zip(places, paths, strict=True)])
    ends = functional.normalize(ends, dim=1)
    first = torch.linalg.eigh(ends.T @ ends).eigenvectors[:, -1]
    along, beside = ends @ first, ends @ torch.linalg.cross(outwards, first)
    forwards = torch.where(along.abs() > _LEVEL, along, beside) >= 0
    names = []
    for own, path, right in zip(slides, paths, forwards.tolist(), strict=True):
        name = torch.zeros(num_parts, dtype=torch.long)
        name[own[path if right else path.flip(0)]] = torch.arange(1, num_parts)
        names.append(name)
    return names


def _outwards(objects: Sequence[ObjectParts]) -> Tensor:  # [3]
    """The axis of the boxes along which parts stick out farthest from what does not slide, in the median object."""
    limits, far = torch.tensor([_EDGE, 1 - _EDGE]), []
    for one in objects:
        low, high = torch.quantile(one.boxes[one.label != one.root], limits.to(one.boxes), dim=0)
        root_low, root_high = torch.quantile(one.boxes[one.label == one.root], limits.to(one.boxes), dim=0)
        far.append(torch.cat([high - root_high, root_low - low]))
    best = int(torch.stack(far).median(dim=0).values.argmax())
    axis = torch.eye(3).to(far[0])[best % 3]
    return axis if best < 3 else -axis


def _shortest_path(
    places: Tensor,  # [L, 3]
) -> Tensor:  # [L]
    """The order in which the way through all of them is shortest."""
    far = torch.cdist(places, places)
    orders = torch.tensor(list(permutations(range(len(places)))))
    return orders[far[orders[:, :-1], orders[:, 1:]].sum(dim=1).argmin()]
