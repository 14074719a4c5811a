"""How well objects that are said to lie are explained as they would be if they stood.

Canonical space lays hinges over each other, so an object that is hinged at another side than most lies there. But a
cloud may as well be explained wrongly, lying where it stands: mostly with a door that is nearly closed, which is out of
the way wherever its hinge is. Of two explanations that fit alike neither is to be believed.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from articulate_ssl.discovery.instance_fit import InstanceFit
from articulate_ssl.discovery.registered_shape import RegisteredShape
from articulate_ssl.geometry.se3 import se3

# By how much worse, as a share, the upright explanation has to be. Of twelve clouds of ovens that lie ten fit .12 to
# .45 worse upright, one .02, and one better; of three of ovens and washing machines that stand and were said to lie all
# fit better (docs/experiments.md, step 321).
_WORSE = 0.05
_STATES = 3  # of every joint, evenly within its limits, from which a descent starts
_CYCLES = (4, 8)  # of descent from all of these, and from the best, as after a search


def lie(
    found: RegisteredShape,  # registered to n clouds, with one joint
    clouds: Tensor,  # [n, N, 3]
    turns: Tensor,  # [n, 3, 3] canonical space as it would stand -> canonical space
) -> Tensor:  # [n] bool
    """Whether nothing upright explains a cloud about as well as the registration does.

    Clouds are of as many points as were registered: distances to denser ones are smaller.
    """
    if not len(clouds):
        return torch.zeros(0, dtype=torch.bool)
    return _upright_errors(found, clouds, turns) > (1 + _WORSE) * found.error


def _upright_errors(found: RegisteredShape, clouds: Tensor, turns: Tensor) -> Tensor:  # [n]
    """`RegisteredShape.error` of the best explanation that is turned so at the start."""
    limits = found.limits() if found.sought is None else found.sought
    shape = replace(found.shape, joints=replace(found.shape.joints, limits=limits))
    rotation, rows = found.base[:, :3, :3] @ turns, torch.arange(len(clouds))
    low, high = limits.unbind(-1)
    tried = []
    for share in torch.linspace(0, 1, _STATES + 2)[1:-1].tolist():
        state = (low + share * (high - low)).expand(len(clouds), -1)
        center = shape.posed(se3(rotation, torch.zeros_like(clouds[:, 0])), state).mean(dim=1)
        tried.append((se3(rotation, clouds.mean(dim=1) - center), state))
    base, state = (torch.cat(values) for values in zip(*tried, strict=True))
    generator = torch.Generator().manual_seed(0)
    for cycles in _CYCLES:
        fit = InstanceFit(shape, base, state, generator)
        copies = clouds.repeat(len(base) // len(clouds), 1, 1)
        fit.optimise(copies, cycles, shared=False)
        error = fit.error(copies, softened=False).unflatten(0, (-1, len(clouds)))
        best = error.argmin(dim=0)
        base, state = (value.unflatten(0, (-1, len(clouds)))[best, rows] for value in (fit.base, fit.state))
    return error.amin(dim=0)
