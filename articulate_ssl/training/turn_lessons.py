"""How it is learnt which way round clouds of sliding parts are, from what the collection says of training clouds.

No label is read. `inference.sliding_search` compares a cloud with clouds of the collection; what it says of a few it
gets wrong, and a network that sees their surface, taught by all, is right of most of these.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from articulate_ssl.ops.progress import announced
from articulate_ssl.training.explanations import with_noise
from articulate_ssl.training.surface_lessons import learn_surface

if TYPE_CHECKING:
    from articulate_ssl.training.module import ArticulatedPoseModule

_BATCH = 16
_AGREE = 0.9  # share of the clouds that it was not taught by, of which a network must say what the collection says

log = logging.getLogger(__name__)


@torch.no_grad()
def learn_turns(
    module: ArticulatedPoseModule,
    clouds: Tensor,  # [n, N, 3] farthest-point order, dense
) -> None:
    """Teach a network which of the leading turns is right."""
    sliding, generator = module.estimator.sliding, torch.Generator().manual_seed(0)
    sliding.surface = None  # of a run that ended and goes on
    shown = announced(log, "turns of the collection", clouds.split(_BATCH))
    frames = torch.cat([sliding.leading_turns(some.cpu())[0].mT for some in shown]).to(clouds)
    noisy = torch.cat([with_noise(some, generator) for some in clouds.split(_BATCH)])
    order = torch.randperm(len(clouds), generator=generator).to(clouds.device)
    sliding.surface = learn_surface((clouds, noisy), frames, order, _AGREE)
