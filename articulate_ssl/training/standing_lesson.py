"""How it is learnt which part stands (`inference.standing_part`): from predictions of training clouds, unlabelled."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from articulate_ssl.ops.progress import announced, tell
from articulate_ssl.training.explanations import registered_points

if TYPE_CHECKING:
    from articulate_ssl.training.module import ArticulatedPoseModule

_BATCH = 16

log = logging.getLogger(__name__)


@torch.no_grad()
def learn_standing_part(
    module: ArticulatedPoseModule,
    clouds: Tensor,  # [n, N, 3] farthest-point order, dense
) -> None:
    """Find out which part is to be the base, of clouds of cameras that are held upright."""
    found = []
    for some in announced(log, "which part stands", clouds.split(_BATCH)):
        prediction = module.predict_points(some[:, : registered_points(module)], dense=some)
        found.append(prediction.part_pose[..., :3, :3])
    standing = module.standing_part
    spread = standing.learn(torch.cat(found), module.articulated.category.chain().root)
    told = ", ".join(f"{angle:.0f}" for angle in spread.rad2deg().tolist())
    tell(
        log,
        "part %d stands: for the camera the steadiest directions of parts spread by %s degrees",
        standing.root,
        told,
    )
