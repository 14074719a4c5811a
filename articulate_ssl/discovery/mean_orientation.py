"""How the objects of depth views are turned in the mean, relative to a shape that was found in complete clouds.

Complete clouds stand in any orientation: nothing in them says how a camera was held. The views do: the shape is
registered to each on its own, from all sides, without a pull at what is hidden. Many views end upside down or back to
front, but in many different ways, while those that are right agree to within the range of views.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import roma
import torch
from torch import Tensor

from articulate_ssl.discovery.registration import register_articulated
from articulate_ssl.discovery.simulated_views import DISTANCE, in_front
from articulate_ssl.geometry.orientation_range import mean_rotation
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.ops.hidden_points import seen_from_origin
from articulate_ssl.shape.articulated_shape import ArticulatedShape

_COARSE_POINTS, _FINE_POINTS = 128, 256
_COARSE, _FINE = ((0.12, 0.05), 6), ((0.05, 0.03), 4)  # scales and rounds of registration
_SURVIVORS = 30
_ALIKE = 60.0  # degrees: views of upright objects are seldom turned farther from their mean
_ROUNDS = 4


def find_mean_orientation(
    shape: ArticulatedShape,  # as large as in the views
    states: Tensor,  # [Q, J] to start from
    views: Tensor,  # [n, N, 3] depth views
    rotations: Tensor,  # [H, 3, 3] to start from
) -> Tensor:  # [3, 3]
    """The rotation canonical object space -> camera that objects have in the mean."""
    start, state = rotations.repeat_interleave(len(states), dim=0), states.repeat(len(rotations), 1)
    coarse, fine = shape.thinned(_COARSE_POINTS), shape.thinned(_FINE_POINTS)
    offset = _seen_centers(shape.posed(se3(start, start.new_zeros(len(start), 3)), state))
    found, errors = [], []
    for view in views:
        base = se3(start, view.mean(dim=0) - offset)
        base, moved, error = _registered(coarse, view[:_COARSE_POINTS], base, state, *_COARSE)
        best = error.topk(min(_SURVIVORS, len(error)), largest=False).indices
        base, moved, _ = _registered(fine, view[:_FINE_POINTS], base[best], moved[best], *_FINE)
        found.append(base[:, :3, :3])
        errors.append(_seen_errors(shape.posed(base, moved), view))
    return _agreed(torch.stack(found), torch.stack(errors))


def _agreed(
    rotation: Tensor,  # [n, C, 3, 3] candidates of each view
    error: Tensor,  # [n, C]
) -> Tensor:  # [3, 3]
    """The mean of the views that agree most, then of each view's best candidate that agrees with that mean."""
    rows = torch.arange(len(rotation))
    best = rotation[rows, error.argmin(dim=1)]
    alike = _degrees(best[:, None], best) < _ALIKE
    mean = mean_rotation(best[alike[alike.sum(dim=1).argmax()]])
    for _ in range(_ROUNDS):
        near = _degrees(rotation, mean) < _ALIKE
        some = near.any(dim=1)
        best = rotation[rows, error.masked_fill(~near, torch.inf).argmin(dim=1)]
        mean = mean_rotation(best[some])
    return mean


def _registered(shape: ArticulatedShape, view: Tensor, base: Tensor, state: Tensor, scales, rounds: int):
    copies = view.expand(len(base), -1, -1)
    return register_articulated(shape, copies, base, state, scales, rounds, bidirectional=False)


def _seen_errors(
    posed: Tensor,  # [C, T, 3]
    view: Tensor,  # [N, 3]
) -> Tensor:  # [C]
    """Distance of a view to shapes, and of what a camera sees of them to the view."""
    distance = torch.cdist(view, posed)  # [C, N, T]
    back = [near[seen].mean() for near, seen in zip(distance.amin(dim=1), _seen(posed), strict=True)]
    return distance.amin(dim=2).mean(dim=1) + torch.stack(back)


def _seen_centers(
    posed: Tensor,  # [n, T, 3]
) -> Tensor:  # [n, 3]
    """The centres of what a camera sees of posed shapes."""
    return torch.stack([points[seen].mean(dim=0) for points, seen in zip(posed, _seen(posed), strict=True)])


def _seen(
    posed: Tensor,  # [n, T, 3]
) -> Iterator[Tensor]:  # [M] each
    """Indices of the points of each shape that a camera sees that looks at its middle along z."""
    for points in posed.double().numpy():
        yield torch.from_numpy(seen_from_origin(points + in_front(points, float(np.mean(DISTANCE)))))


def _degrees(a: Tensor, b: Tensor) -> Tensor:
    return roma.rotmat_geodesic_distance(*torch.broadcast_tensors(a, b)).rad2deg()
