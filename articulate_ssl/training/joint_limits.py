"""How joint limits are learnt (`inference.state_range`): from predictions of training clouds, without labels."""

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
FEWEST = 32  # clouds; the ends of a range show in no handful. Chosen.

log = logging.getLogger(__name__)


@torch.no_grad()
def learn_joint_limits(
    module: ArticulatedPoseModule,
    clouds: Tensor,  # [n, N, 3] farthest-point order, dense
) -> None:
    """Find out which joint states there are, where parts turn and predictions take clouds' proportions.

    How wide a joint's range is, the configuration says (`state_range`), and where it lies, most predictions.
    """
    estimator, states, sides = module.estimator, module.states, module.hinge_sides
    states.forget()  # of a run that ended and goes on
    if not estimator.final.fits or not module.inference.refine or len(clouds) < FEWEST:
        return
    found = []
    for some in announced(log, "joint limits", clouds.split(_BATCH)):
        prediction = estimator.predict(some[:, : registered_points(module)], module.num_points, dense=some)
        found.append(prediction.joint_state + sides.closed * sides.learnt)
    states.learn(torch.cat(found), module.hparams["state_range"])
    for joint, (low, high) in enumerate(states.seen.rad2deg().tolist()):
        tell(log, "joint %d: states from %.0f to %.0f degrees", joint, low, high)
