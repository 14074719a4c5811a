"""How it is learnt where the hinges of plates are (`inference.closed_contact`): from predictions of training clouds.

Closed, a lid lies on its base. By how much those of training clouds would miss that, about the hinges that are
predicted, says where these are: how much a hinge that is off across its lid matters, and along it, depends on how far
the lid is open, so clouds of all states tell both. No label is read.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.inference.closed_contact import Contact
from articulate_ssl.inference.hinge_sides import closed_state
from articulate_ssl.inference.prediction import concatenate
from articulate_ssl.ops.progress import announced, tell
from articulate_ssl.training.explanations import registered_points

if TYPE_CHECKING:
    from articulate_ssl.training.module import ArticulatedPoseModule

_BATCH = 16
_FEWEST = 32  # clouds that show both plates. Chosen.
_THIN = 0.25  # of its largest extent the smallest of a plate at most (laptops: .07 and .09; boxes: .66 to .83)

log = logging.getLogger(__name__)


@torch.no_grad()
def learn_closed_contact(
    module: ArticulatedPoseModule,
    clouds: Tensor,  # [n, N, 3] farthest-point order, dense
) -> None:
    """Find out where the hinges of two plates are."""
    estimator, network, sides = module.estimator, module.articulated, module.hinge_sides
    known = estimator.closed_plates
    known.learnt.fill_(False)  # of a run that ended and goes on
    if module.num_parts != 2 or network.joint_type != REVOLUTE:
        return
    shape = network.category.articulated_shape(network.joint_type)
    if max(_thickness(shape.part(part)) for part in range(2)) > _THIN:
        return
    count = registered_points(module)
    found = concatenate(
        [
            estimator.predict(some[:, :count], module.num_points, dense=some)
            for some in announced(log, "closed plates", clouds.split(_BATCH))
        ]
    )
    closed = closed_state(shape, module.states.known, module.part_frames)
    known.closed.fill_(closed - float(sides.closed) * bool(sides.learnt))
    contact = Contact.of(found, clouds, known.closed, plates=True)
    if int(contact.known.sum()) < _FEWEST:
        tell(log, "closed plates: %d clouds show both, which is too few", int(contact.known.sum()))
        return
    known.off.copy_(contact.off())
    known.learnt.fill_(True)
    tell(log, "closed plates: hinges are %.3f off across plates, %.3f along them", *known.off.tolist())


def _thickness(points: Tensor) -> float:
    """The smallest extent of a part's points [m, 3], of the largest."""
    axes = torch.linalg.eigh(torch.cov(points.T)).eigenvectors
    extent = (points @ axes).amax(dim=0) - (points @ axes).amin(dim=0)
    return float(extent.min() / extent.max())
