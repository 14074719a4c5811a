"""One decision for a whole collection: which of a finite group's rotations each cloud is turned by.

Pairs of clouds decide badly (of chests of drawers, a third of all pairs is most alike upside down or front to back), a
single template hardly better; all pairs together decide well. Group synchronization: choose an element per cloud so
that all pairs of clouds, turned by theirs, are as alike as possible.

Pairs count by how much they say: two chests that are about as alike one way as another say little, and chests that
differ in kind, a bedside table and a desk, less than chests that are nearly the same. On three sets of chests 91 to
94 % of the clouds stood alike in the end by the first, 93 to 96 % by the second after it, 82 to 85 % where all pairs
count the same (docs/experiments.md, step 98).
"""

from __future__ import annotations

import logging

import torch
from torch import Tensor

from articulate_ssl.discovery.distance_field import DistanceFields
from articulate_ssl.geometry.rotation_group import RotationGroup
from articulate_ssl.ops.progress import announced

_POINTS = 512  # of a cloud, compared with the field of another
_MARGIN_POINTS = 128  # the same, for `standing_margins`
_TURN_POINTS = 64  # the same, for `turned_as_the_alike`; 128 are no more right, 32 less
CAP = 0.1  # distances beyond count as this, in widths of the unit box
NEIGHBOURS = 8  # clouds most like a cloud, which have the last word about it
_STARTS, _SWEEPS = 24, 30

log = logging.getLogger(__name__)


def unit_boxes(
    clouds: Tensor,  # [n, N, 3]
) -> tuple[Tensor, Tensor, Tensor]:  # [n, N, 3], [n, 3], [n, 3]
    """Clouds stretched to boxes of width one about the origin, and the centres and widths they had.

    A box ends where all but a hundredth of the points at either end are inside.
    """
    low, high = torch.quantile(clouds, 0.01, dim=1), torch.quantile(clouds, 0.99, dim=1)
    center, width = (low + high) / 2, (high - low).clamp(min=1e-6)
    return (clouds - center[:, None]) / width[:, None], center, width


def pairwise_costs(
    clouds: Tensor,  # [n, N, 3] in a unit box, farthest-point order
    group: RotationGroup,
) -> Tensor:  # [n, n, G]
    """Capped Chamfer distance between cloud i and cloud j turned by each element."""
    turned = torch.einsum("gij,npj->ngpi", group.elements.to(clouds), clouds[:, :_POINTS])
    # One field at a time: those of some hundred clouds are gigabytes.
    fields = (DistanceFields.of(cloud[None]) for cloud in clouds)
    one_sided = torch.stack([field.at(0, turned).clamp(max=CAP).mean(dim=-1) for field in fields])
    return one_sided + one_sided.transpose(0, 1)[..., group.inverse]


def synchronise(
    costs: Tensor,  # [n, n, G] of cloud i and cloud j turned by an element
    group: RotationGroup,
    generator: torch.Generator,
) -> Tensor:  # [n] int64
    """The element that each cloud is to be turned by, up to one element that is common to all.

    From what single clouds say about all others; each cloud in turn then takes the element that fits all others best,
    every pair weighted by how decided it is. The lowest total cost over all starts wins. From there on each cloud
    takes the element that fits those best that it is most like.
    """
    decided = costs * decidedness(costs)[..., None]
    first = torch.randint(len(costs), (_STARTS,), generator=generator).tolist()
    found = [_descend(decided, decided[start].argmin(dim=-1), group, generator) for start in first]
    best = min(found, key=lambda element: total_cost(decided, element, group))
    return _descend(costs * _neighbours(costs)[..., None], best, group, generator)


def decidedness(
    costs: Tensor,  # [n, n, G]
) -> Tensor:  # [n, n]
    """By how much the best element of a pair is better than the second best."""
    best, second = costs.topk(2, dim=-1, largest=False).values.unbind(-1)
    return second - best


def _neighbours(
    costs: Tensor,  # [n, n, G]
) -> Tensor:  # [n, n]
    """One for pairs of which one is among the clouds most like the other, else zero."""
    least = costs.amin(dim=-1).fill_diagonal_(torch.inf)
    near = least.topk(min(NEIGHBOURS, len(costs) - 1), dim=1, largest=False).indices
    chosen = torch.zeros_like(least).scatter_(1, near, 1.0)
    return torch.maximum(chosen, chosen.T)


def total_cost(costs: Tensor, element: Tensor, group: RotationGroup) -> float:
    """Sum over all pairs of different clouds."""
    relative = group.product[group.inverse[element]][:, element]  # [n, n] a_i^{-1} a_j
    chosen = costs.gather(2, relative[..., None]).squeeze(-1)
    return float(chosen.sum() - chosen.diagonal().sum())


def standing_margins(
    boxes: Tensor,  # [n, N, 3] in a unit box, farthest-point order, turned as they are found to stand
    group: RotationGroup,
) -> Tensor:  # [n]
    """By what share each cloud is liker the clouds most like it as it stands than turned by any other element.

    Negative if it is liker turned otherwise. Of 192 clouds of chests of which 12 % stood wrongly, none of these was
    among the three quarters with the largest margins (docs/experiments.md, step 104).
    """
    turned = torch.einsum("gji,npj->gnpi", group.elements.to(boxes), boxes[:, :_MARGIN_POINTS])
    margins = []
    for number, box in enumerate(boxes):
        cost = DistanceFields.of(box[None]).at(0, turned).clamp(max=CAP).mean(dim=-1)  # [G, n]
        others = torch.cat([cost[:, :number], cost[:, number + 1 :]], dim=1)
        alike = others.topk(min(NEIGHBOURS, others.shape[1]), dim=1, largest=False).values.mean(dim=1)
        standing = alike[group.identity].clone()
        alike[group.identity] = torch.inf
        margins.append(alike.min() / standing.clamp(min=1e-6) - 1)
    return torch.stack(margins)


def turned_as_the_alike(
    turns: Tensor,  # [n, C, 3, 3] of each cloud, which differ by elements of the cube's group, the likeliest first
    clouds: Tensor,  # [n, N, 3] farthest-point order
) -> Tensor:  # [n] int64
    """Which of its turns each cloud takes: in which it is most like those clouds that are most like it, as these stand.

    Every cloud stands in its first turn until it is its own turn to choose. A sweep of `synchronise` over clouds that
    are too many for all pairs to be compared in all ways: of 1,000 chests 7.4 % are wrong by the 128 chests of
    `inference.sliding_search`, 3.7 % by each other (docs/experiments.md, step 352).
    """
    standing = unit_boxes(clouds @ turns[:, 0].mT)[0][:, :_TURN_POINTS].clone()
    others = torch.ones(len(clouds), dtype=torch.bool)
    chosen = torch.zeros(len(clouds), dtype=torch.long)
    for number, cloud in enumerate(announced(log, "turns of clouds by those most alike", clouds)):
        others[number] = False
        if others.any():
            cost = distances_to_others(cloud, turns[number].mT, standing[others])
            chosen[number] = mean_of_nearest(cost).argmin()
        others[number] = True
        standing[number] = standing[number] @ (turns[number, chosen[number]] @ turns[number, 0].mT).mT
    return chosen


def distances_to_others(
    cloud: Tensor,  # [P, 3]
    standing: Tensor,  # [G, 3, 3] frames in which it may stand -> its own, elements of the cube's group apart
    others: Tensor,  # [n, M, 3] that stand, in boxes of width one
) -> Tensor:  # [G, n]
    """Mean distances of others to the cloud, in a box of width one, however it stands."""
    box, _, _ = unit_boxes((cloud @ standing[0])[None])
    # What stands at x in one frame is in the first at r @ x.
    turned = torch.einsum("gij,npj->gnpi", standing[0].mT @ standing, others)
    return DistanceFields.of(box).at(0, turned).clamp(max=CAP).mean(dim=-1)


def mean_of_nearest(
    distance: Tensor,  # [..., n]
) -> Tensor:  # [...]
    """Of the few others that are most alike."""
    return distance.topk(min(NEIGHBOURS, distance.shape[-1]), dim=-1, largest=False).values.mean(dim=-1)


def _descend(costs: Tensor, element: Tensor, group: RotationGroup, generator: torch.Generator) -> Tensor:
    element = element.clone()
    for _ in range(_SWEEPS):
        before = element.clone()
        for i in torch.randperm(len(costs), generator=generator).tolist():
            relative = group.product[group.inverse][:, element]  # [G, n] h^{-1} a_j for every choice h of cloud i
            cost = costs[i].gather(1, relative.T)  # [n, G]
            cost[i] = 0
            element[i] = cost.sum(dim=0).argmin()
        if torch.equal(element, before):
            break
    return element
