"""Which scanned objects lie in the frame that discovery gives them, and how they would stand; learnt without labels.

A category has one joint, so discovery lays hinges over each other, and an oven that is hinged at its side lies on it
(`inference.hinge_sides`). A camera sees none lie, so views of it are to be simulated as it stands. As of predictions,
the body says how, and nothing of the door is shown; but here few clouds teach enough: those that discovery explains
best are nearly all of objects that are hinged as most are, as one that lies has other proportions than most. Of 120
ovens a network that saw the best 144 clouds found all 14 clouds of the eight that lie, in one round of lessons
(docs/experiments.md, step 240).
"""

from __future__ import annotations

import logging
import math

import roma
import torch
from torch import Tensor

from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.inference.hinge_sides import BODY_SIZE, DECIDED, Bodies, HingeSides
from articulate_ssl.ops.progress import tell
from articulate_ssl.training.explanations import with_noise
from articulate_ssl.training.surface_lessons import TAUGHT, Lessons, teach

_BATCH = 16
_FEWEST = 64  # clouds that teach. Chosen.
_TIMES = 40  # that each is shown, as there are few. No other was tried to the end.
# Shares of those that are explained best and did not teach: in which enough is seen of the body, and that stand as they
# are explained, without which bodies do not tell. Chosen.
_KNOWN, _STAND = 0.9, 0.85

log = logging.getLogger(__name__)


def quarters_to_stand(
    found: RegisteredShape,  # registered to the clouds
    clouds: Tensor,  # [n, P, 3] complete, farthest-point order
    best: Tensor,  # [m] those whose explanations are right, but for a few
) -> tuple[Tensor, Tensor]:  # [n], [n, 3, 3]
    """By how many quarters each object is to be turned until it stands as most do, and canonical space with it.

    Zero of most; and of all where bodies do not tell, or that of a cloud does not, or its joint is beyond where joints
    of the best are: such a cloud is explained wrongly, and how its object stands is not known.

    Returns:
        Quarters, and rotations [n, 3, 3] of the canonical frame as it stands into the one that is explained.
    """
    quarters = torch.zeros(len(clouds), dtype=torch.long)
    turns = torch.eye(3).to(clouds).expand(len(clouds), 3, 3)
    if found.shape.num_parts != 2 or found.shape.joints.joint_type != REVOLUTE or len(best) < _FEWEST:
        return quarters, turns
    limits = found.of_clouds(best).limits()
    sides = HingeSides()
    sides.measure(found.shape, limits)
    bodies = _bodies(sides, found, clouds)
    if float(bodies.known[best].double().mean()) < _KNOWN:
        tell(log, "how scans stand: too little is seen behind the closed door")
        return quarters, turns
    order = best[torch.randperm(len(best), generator=torch.Generator().manual_seed(0))]
    taught, rest = order.split([count := int(TAUGHT * len(order)), len(order) - count])
    sides.surface = teach(Lessons(*bodies.rows(taught)[:3]), "how scans stand", BODY_SIZE, _TIMES)
    odds = torch.cat([sides.looks_right(bodies.rows(some)) for some in torch.arange(len(clouds)).split(_BATCH)])
    stand = float((odds[rest].argmax(dim=1) == 0).double().mean())
    if stand < _STAND:
        tell(log, "how scans stand: bodies do not tell, only %.0f %% of those left out stand", 100 * stand)
        return quarters, turns
    looks, ways = odds.topk(2, dim=1)
    low, high = limits.unbind(-1)
    likely = ((found.state >= low) & (found.state <= high)).all(dim=1)
    decided = bodies.known & likely & (looks[:, 0] - looks[:, 1] >= DECIDED)
    quarters = torch.where(decided, ways[:, 0], quarters)
    tell(log, "how scans stand: %d of %d lie", int((quarters > 0).sum()), len(clouds))
    angle = quarters.to(clouds) * (math.pi / 2)
    return quarters, roma.rotvec_to_rotmat(angle[:, None] * sides.axes[:, 2])


def _bodies(sides: HingeSides, found: RegisteredShape, clouds: Tensor) -> Bodies:
    """What is seen of them, as they are and with noise."""
    generator = torch.Generator().manual_seed(0)
    return Bodies.cat(
        sides.bodies_at(base, some, (some, with_noise(some, generator)))
        for some, base in zip(clouds.split(_BATCH), found.base.split(_BATCH), strict=True)
    )
