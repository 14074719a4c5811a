"""How a network learns which of two exchanged parts is which, seen from near (`inference/swapped_parts.py`).

It is taught by what relief decides, as one that sees whole clouds is (`surface_lessons`). No label is read.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import torch
from torch import Tensor

from articulate_ssl.inference.surface_decision import SurfaceDecision
from articulate_ssl.inference.swapped_parts import SIZE, PartViews, log_odds_from_near
from articulate_ssl.network.surface_network import SurfaceCloud, SurfaceSize
from articulate_ssl.ops.progress import tell
from articulate_ssl.training.surface_lessons import FEWEST, TAUGHT, Lessons, believable, drawn_points, teach

_CHUNK = 64  # clouds at a time

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PartLessons(Lessons):
    """Clouds of whose two exchanged parts it is known which is the first: points, surface and frames as in `PartViews`.

    The first part comes first, and each is seen in the one frame that it has.
    """

    @staticmethod
    def of_views(
        views: PartViews,
        right: Tensor,  # [n] whether the explanations that these are of are right, and not their twins
    ) -> PartLessons:
        """From views of explanations."""
        first = torch.stack([~right, right], dim=1).long()  # [n, 2] of each, the part that is to come so
        rows = torch.arange(len(right), device=right.device)[:, None]
        return PartLessons(views.points[:, rows, first], views.surface[:, rows, first], views.frames[rows, first])

    def draw(self, count: int, size: SurfaceSize, generator: torch.Generator) -> tuple[SurfaceCloud, Tensor]:
        """Both parts of some of the clouds, in versions and of points drawn anew; and the frame of each."""
        versions, clouds, parts, shown, _ = self.points.shape
        chosen = torch.randperm(clouds, generator=generator)[:count].repeat_interleave(parts)[:, None]
        version = torch.randint(versions, (len(chosen) // parts, 1), generator=generator).repeat_interleave(parts, 0)
        part = torch.arange(parts).repeat(len(chosen) // parts)[:, None]
        seen = drawn_points(len(chosen), shown, size.read, generator)
        return self.cloud((version, chosen, part, seen), size), self.frames[chosen, part]


def learn_from_near(
    views: PartViews,  # of n clouds and their explanations
    right: Tensor,  # [n] bool, whether these are held to be right, and not their twins
    whole: Tensor,  # [n] log odds that they are, of a network that sees whole clouds; 0 where there is none
    order: Tensor,  # [m] clouds that the teacher knows something of: of those to be taught by first
    least: float,
) -> SurfaceDecision | None:
    """A network taught by the leading clouds; None, if of the others it says too seldom what the teacher says.

    Args:
        least: That share.
    """
    order = order[views.known[order]]
    taught, rest = order.split([count := int(TAUGHT * len(order)), len(order) - count])
    if len(taught) < FEWEST:
        tell(log, "no network sees parts from near: that takes %d clouds, there are %d", FEWEST, len(taught))
        return None
    lessons = PartLessons.of_views(views.rows(taught), right[taught])
    decision = teach(lessons, "a network learns to tell parts apart", SIZE)
    odds = torch.cat([log_odds_from_near(decision, views.rows(some)) for some in rest.split(_CHUNK)])
    side = 2.0 * right[rest].to(odds) - 1
    agrees = float((side * odds > 0).double().mean())
    tell(log, "taught by %d pairs of parts, it says of %.0f %% of the others what taught it", len(taught), 100 * agrees)
    if agrees < least:
        log.warning("that is too few: no network sees parts from near")
        return None
    decision.temperature.copy_(believable(side * (odds + whole[rest])))
    return decision
