"""How `inference.sliding_search` gets clouds of more objects whose points have parts: in the multi-state setting.

No label is read, but which clouds show the same object is known, as where discovery found a few objects from their
clouds (`discovery.grouped`). What these say of other objects is confirmed by how each of those moves
(`discovery.one_object.as_others`), in a third of the time that discovery takes. An object that discovery found itself
is asked about again, and its own clouds are among those that answer. In the end all are named alike: names that the
few gave to kinds of objects that were rare among them may be as they came. They also say between which states joints
are, and teach a network that says which part points of other objects are of (`part_lessons`).
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from articulate_ssl.discovery.agreement import renaming
from articulate_ssl.discovery.discover import DiscoveryError
from articulate_ssl.discovery.named_alike import ObjectParts, named_alike
from articulate_ssl.discovery.one_object.find import MIN_CLOUDS
from articulate_ssl.discovery.references import evenly_chosen
from articulate_ssl.discovery.similar_clouds import LabelledClouds
from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.ops.progress import announced, tell
from articulate_ssl.training.part_lessons import teach_parts

if TYPE_CHECKING:
    from articulate_ssl.training.module import ArticulatedPoseModule

_ENOUGH = 0.9  # as many clouds as there were, of which a few objects may not be understood again. Chosen.

log = logging.getLogger(__name__)


@torch.no_grad()
def learn_objects(
    module: ArticulatedPoseModule,
    clouds: Tensor,  # [n, N, 3] farthest-point order, dense
    instance: Tensor,  # [n] which object each shows
) -> None:
    """Keep the clouds of every object that is understood, if that are as many as there were, and teach a network."""
    sliding, chain = module.estimator.sliding, module.articulated.category.chain()
    rows = [(instance == one).nonzero()[:, 0] for one in instance.unique()]
    rows = [evenly_chosen(own, MIN_CLOUDS) for own in rows if len(own) >= MIN_CLOUDS]
    found, standing = [], []
    for own in announced(log, "parts of more objects", rows):
        try:
            labelled, turn = sliding.understood(chain, clouds[own])
        except DiscoveryError as error:
            log.info("an object is left out: %s", error)
            continue
        found.append(labelled)
        standing.append(clouds[own].cpu() @ turn.mT)
    tell(log, "parts of %d of %d objects are understood", len(found), len(rows))
    if not found or sum(len(one.part) for one in found) < _ENOUGH * len(sliding.labelled):
        return
    named = _named_alike(found, chain)
    stood = torch.cat(standing)
    sliding.learn_labelled(named)
    module.states.limits.copy_(sliding.learn_limits(chain, stood, named.part))
    sliding.parts = teach_parts(stood, named.part, sliding.joints(chain)).to(sliding.points.device)


def _named_alike(found: Sequence[LabelledClouds], chain: KinematicChain) -> LabelledClouds:
    """Clouds of several objects, their parts named by one rule, which calls most points what they were called."""
    count = chain.num_parts
    before = [one.part.long() for one in found]
    objects = [ObjectParts(one.points, part, chain.root) for one, part in zip(found, before, strict=True)]
    part = torch.cat([name[one] for name, one in zip(named_alike(objects, count), before, strict=True)])
    return LabelledClouds(torch.cat([one.points for one in found]), renaming(part, torch.cat(before), count)[part])
