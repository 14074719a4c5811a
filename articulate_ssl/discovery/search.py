"""Search for an articulated shape in clouds, over all orientations and joint states, by successive halving."""

from __future__ import annotations

from typing import NamedTuple

import roma
import torch
from torch import Tensor

from articulate_ssl.discovery.registration import chamfer_l1, register_articulated
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.shape.articulated_shape import ArticulatedShape


class _Stage(NamedTuple):
    """One stage of the search: how finely survivors of the stage before are registered, and how many survive."""

    points: int
    scales: tuple[float, float]  # of the correspondences, normalised units
    rounds: int
    survivors: int


# With other stages, halving was as accurate on development laptops as all starts on all points, at a third of the time
# (docs/experiments.md, step 4).
_HALVING = (
    _Stage(96, (0.14, 0.08), 3, 24),
    _Stage(128, (0.08, 0.04), 4, 12),
    _Stage(256, (0.05, 0.03), 4, 12),
)
_SAME = 0.5  # radians: orientations closer than this are one hypothesis
_LATER = 1e3  # added to the error of what is like a better hypothesis: more than any distance


def search_articulated(
    shape: ArticulatedShape,
    clouds: Tensor,  # [n, N, 3], farthest-point order
    rotations: Tensor,  # [H, 3, 3] starts, about the centres
    states: Tensor,  # [Q, J] joint states to start from
) -> tuple[Tensor, Tensor, Tensor]:
    """The best, different articulated registrations of every cloud over all orientations and joint states.

    Successive halving: all starts get a few rounds on few points, the better ones, if they differ, some more. All
    points order the last: what tells a laptop's lid from its base is finer than the spacing of the few points that
    suffice to register it.

    Returns:
        Base poses [n, C, 4, 4], joint states [n, C, J], Chamfer-L1 errors [n, C], best first.
    """
    base, state = _starts(shape, clouds, rotations, states)
    rows = torch.arange(len(clouds), device=clouds.device)[:, None]
    for stage in _HALVING:
        count = base.shape[1]
        copies = clouds[:, : stage.points].repeat_interleave(count, dim=0)
        thin = shape.thinned(stage.points)
        flat = register_articulated(thin, copies, base.flatten(0, 1), state.flatten(0, 1), stage.scales, stage.rounds)
        base, state, error = (value.unflatten(0, (len(clouds), count)) for value in flat)
        best = different(base, error, min(stage.survivors, count))
        base, state, error = base[rows, best], state[rows, best], error[rows, best]
    posed = shape.posed(base.flatten(0, 1), state.flatten(0, 1))
    error = chamfer_l1(clouds.repeat_interleave(base.shape[1], dim=0), posed).unflatten(0, (len(clouds), -1))
    order = error.argsort(dim=1)
    return base[rows, order], state[rows, order], error[rows, order]


def _starts(shape: ArticulatedShape, clouds: Tensor, rotations: Tensor, states: Tensor) -> tuple[Tensor, Tensor]:
    """Base poses [n, H Q, 4, 4] that bring the shape's centre to the cloud's, and joint states [n, H Q, J]."""
    still = torch.eye(4).to(clouds).expand(len(states), 4, 4)
    centers = shape.posed(still, states).mean(dim=1)  # [Q, 3]
    shift = clouds.mean(dim=1)[:, None, None] - torch.einsum("hij,qj->hqi", rotations, centers)
    base = se3(rotations[None, :, None].expand(len(clouds), -1, len(states), -1, -1), shift).flatten(1, 2)
    return base, states.repeat(len(rotations), 1).expand(len(clouds), -1, -1)


def different(
    base: Tensor,  # [n, C, 4, 4]
    error: Tensor,  # [n, C]
    count: int,
) -> Tensor:  # [n, count]
    """Indices of the best hypotheses, passing over those turned like a better one while others are left."""
    rows = torch.arange(len(base), device=base.device)
    left, chosen = error.clone(), []
    for _ in range(count):
        best = left.argmin(dim=1)
        chosen.append(best)
        angle = roma.rotmat_geodesic_distance(base[..., :3, :3], base[rows, best, None, :3, :3])
        left = (left + _LATER * (angle < _SAME)).scatter(1, best[:, None], torch.inf)
    return torch.stack(chosen, dim=1)
