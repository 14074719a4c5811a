"""Explanations of clouds to choose among: hypotheses of one pose estimation, their errors, and who rivals whom."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import roma
import torch
from torch import Tensor

from articulate_ssl.network.hypotheses import Hypotheses, either
from articulate_ssl.ops.chamfer import hypothesis_distances, nearest_distance
from articulate_ssl.shape.observation import Observation

ANOTHER_WAY = math.radians(30)  # beyond, one of two hypotheses is wrong (`metrics.above_30_rate`)
_AGREEING_POINTS = 64  # of a cloud, farthest-point order: which way round its parts are shows in few


def rivals(
    error: Tensor,  # [B, C] of the hypotheses
    base: Tensor,  # [B, C, 4, 4]
    chosen: Tensor,  # [B]
    allowed: Tensor,  # [B, C] bool, which ones may be rivals
) -> tuple[Tensor, Tensor]:  # [B], [B]
    """Rivals of chosen hypotheses, the best ones that are turned another way, and `Prediction.margin`.

    Where none is turned another way, the chosen one is its own rival, and the margin 1.
    """
    rows = torch.arange(len(chosen), device=chosen.device)
    rotation = base[..., :3, :3]
    angle = roma.rotmat_geodesic_distance(rotation, rotation[rows, chosen, None].expand_as(rotation))
    least, rival = error.masked_fill(~allowed | (angle < ANOTHER_WAY), torch.inf).min(dim=1)
    return torch.where(least.isinf(), chosen, rival), (1 - error[rows, chosen] / least).clamp(0, 1)


@torch.no_grad()
def part_distances(
    points: Tensor,  # [B, C, 3]
    posed: Tensor,  # [B, H, K, M, 3]
    association: Tensor,  # [B, C, K], rows sum to one
) -> Tensor:  # [B, H]
    """Mean distance of points to the parts that they belong to, of every hypothesis, for choosing among them."""
    result = 0.0
    for part, weight in zip(posed.unbind(2), association.unbind(-1), strict=True):
        query = points[:, None].expand(-1, part.shape[1], -1, -1)
        result = result + (nearest_distance(query, part) * weight[:, None]).mean(dim=-1)
    return result


@dataclass(frozen=True)
class Iteration:
    """One pose estimation of clouds.

    Attributes:
        points: [B, N, 3] the clouds, aligned.
        hypotheses: One per group element.
        start: The estimate that the hypotheses are residuals to (the winner of the iteration before), or None.
        observation: How hypotheses are compared; those that are turned too far are the last to be chosen.
        agreement: Weight, beside d(X, Y^g), of the distance to the parts that the slot attention assigns.
        compared: So many points of a cloud, and as many of a hypothesis, are compared; None compares all.
    """

    points: Tensor
    hypotheses: Hypotheses
    start: Hypotheses | None
    observation: Observation
    agreement: float = 0.0
    compared: int | None = None

    @cached_property
    @torch.no_grad()
    def distance(self) -> Tensor:
        """d(X, Y^g) of every hypothesis, and that of its parts to theirs if that counts, [B, H], without gradient."""
        posed = self.hypotheses.posed(self._every)
        points = self.points[:, : self.compared]
        whole = hypothesis_distances(points, posed.flatten(2, 3), bidirectional=self.observation.bidirectional)
        if self.agreement == 0:
            return whole
        logits = self.hypotheses.association_logits[:, :_AGREEING_POINTS]
        return whole + self.agreement * part_distances(self.points[:, : logits.shape[1]], posed, logits.softmax(dim=-1))

    @property
    def _every(self) -> int:
        """Of the points of a part one in so many is compared."""
        if self.compared is None:
            return 1
        parts, shape_points = self.hypotheses.part_shape.shape[1:3]
        return max(1, parts * shape_points // self.compared)

    @property
    def winner(self) -> Tensor:
        """argmin_g d(X, Y^g), [B]."""
        return self.leading(1)[:, 0]

    def leading(self, count: int) -> Tensor:
        """The hypotheses of the smallest d(X, Y^g), best first, [B, count]."""
        return self.ranked.topk(count, largest=False).indices

    @cached_property
    def ranked(self) -> Tensor:
        """`distance`, larger than all others where a hypothesis is turned too far, [B, H]."""
        return self.observation.ranked(self.distance, self.hypotheses.base[..., :3, :3])


@dataclass(frozen=True)
class Candidates:
    """Explanations of clouds, among which one is chosen.

    Attributes:
        error: [B, C] of each.
        base: [B, C, 4, 4] base poses.
        state: [B, C, J] joint states.
        select: One of each cloud, by its index [B], as H = 1.
        said: [B, 3, 3] how the network alone turns objects, before anything is registered; None: it was not asked.
    """

    error: Tensor
    base: Tensor
    state: Tensor
    select: Callable[[Tensor], Hypotheses]
    said: Tensor | None = None


def better(
    first: Hypotheses,  # H = 1
    error: Tensor,  # [B]
    others: Candidates,
    turn: Tensor,  # [B, 3, 3]
) -> Hypotheses:  # H = 1
    """Of a hypothesis of every cloud, and those of others that are turned about so, the one with the least error."""
    away = angle_to(others.base[..., :3, :3], turn) > ANOTHER_WAY
    least, index = others.error.masked_fill(away, torch.inf).min(dim=1)
    return either(error <= least, first, others.select(index))


def likelier(
    odds: Tensor,  # [B] logarithm of those of the first
    one: Hypotheses,  # H = 1
    other: Hypotheses,  # H = 1
    temperature: Tensor | float,  # [] of the odds
) -> tuple[Hypotheses, Hypotheses, Tensor]:  # H = 1, H = 1, [B]
    """The likelier, the other, and how much likelier than not it is."""
    return either(odds < 0, other, one), either(odds < 0, one, other), (odds.abs() / (2 * temperature)).tanh()


def frames_of(
    one: Hypotheses,  # H = 1
    other: Hypotheses,  # H = 1
) -> Tensor:  # [B, 2, 3, 3]
    """Canonical object space -> camera space, of both."""
    return torch.cat([one.base, other.base], dim=1)[..., :3, :3]


def angle_to(
    rotation: Tensor,  # [B, C, 3, 3]
    turn: Tensor,  # [B, 3, 3]
) -> Tensor:  # [B, C]
    return roma.rotmat_geodesic_distance(rotation, turn[:, None].expand_as(rotation))
