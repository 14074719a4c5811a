"""How it is learnt which way round objects with sliding parts are, from what is said of training clouds.

No label is read. `inference.sliding_search` compares a whole cloud with a few clouds of the collection, and then all
that teach are compared with each other; `inference.view_search` compares a depth view with simulated ones. What they
say of a few they get wrong, and a network that sees their surface, taught by all, is right of most of these.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn import functional

from articulate_ssl.discovery.synchronization import turned_as_the_alike
from articulate_ssl.inference.surface_decision import SurfaceDecision
from articulate_ssl.ops.progress import announced, tell
from articulate_ssl.training.explanations import with_noise
from articulate_ssl.training.line_lessons import explain
from articulate_ssl.training.surface_lessons import learn_surface

if TYPE_CHECKING:
    from articulate_ssl.inference.sliding_search import SlidingSearch
    from articulate_ssl.training.module import ArticulatedPoseModule

_BATCH = 16
_FEW = 512  # clouds that stand each other up before all are asked
_AGREE = 0.9  # share of the clouds that it was not taught by, of which a network must say what it was taught

log = logging.getLogger(__name__)


@torch.no_grad()
def learn_turns(
    module: ArticulatedPoseModule,
    clouds: Tensor,  # [n, N, 3] farthest-point order, dense
) -> None:
    """Teach a network which of the leading turns is right, and keep clouds that stand as those most like them do.

    A few clouds stand each other up first: some that discovery kept stand otherwise.
    """
    sliding, generator = module.estimator.sliding, torch.Generator().manual_seed(0)
    sliding.surface = None  # of a run that ended and goes on
    _as_the_alike(sliding, clouds[:_FEW].cpu())
    frames = _as_the_alike(sliding, clouds.cpu()).mT.to(clouds)
    sliding.surface = _taught(clouds, frames, torch.ones(len(clouds), dtype=torch.bool), generator)


def _as_the_alike(
    sliding: SlidingSearch,
    clouds: Tensor,  # [n, N, 3]
) -> Tensor:  # [n, C, 3, 3]
    """The leading turns of each cloud, that in which it is like others first; the search goes by these then."""
    shown = announced(log, "turns of the collection", clouds.split(_BATCH))
    turns = torch.cat([sliding.leading_turns(some)[0] for some in shown])
    chosen = turned_as_the_alike(turns, clouds)
    tell(log, "clouds most alike turn %.1f %% of all otherwise", 100 * float((chosen > 0).double().mean()))
    order = functional.one_hot(chosen, turns.shape[1]).argsort(dim=1, descending=True, stable=True)
    turns = turns[torch.arange(len(turns))[:, None], order]
    sliding.learn_standing(clouds, turns[:, 0].mT)
    return turns


@torch.no_grad()
def learn_view_turns(
    module: ArticulatedPoseModule,
    views: Tensor,  # [n, N, 3] farthest-point order, dense
) -> None:
    """Teach a network which of the turns that are square to views' frames is right, if it is known how frames lie."""
    frame, generator = module.object_frame, torch.Generator().manual_seed(0)
    frame.surface = None
    if not frame.learnt:
        return
    explained = explain(module, views, "turns of views").base[:, 0, :3, :3]
    batches = zip(views.split(_BATCH), explained.split(_BATCH), strict=True)
    square, has = zip(*(frame.square(*some) for some in batches), strict=True)
    frame.surface = _taught(views, torch.cat(square) @ frame.axes, torch.cat(has), generator)


def _taught(
    clouds: Tensor,  # [n, N, 3]
    frames: Tensor,  # [n, S, 3, 3] the right one first
    known: Tensor,  # [n] bool, which clouds teach
    generator: torch.Generator,
) -> SurfaceDecision | None:
    noisy = torch.cat([with_noise(some, generator) for some in clouds.split(_BATCH)])
    order = torch.randperm(len(clouds), generator=generator).to(clouds.device)
    return learn_surface((clouds, noisy), frames, order[known.to(order.device)[order]], _AGREE)
