"""How the objects of depth views are turned, relative to a shape that was found in complete clouds.

Complete clouds stand in any orientation: nothing in them says how a camera was held. The views do: the shape is
registered to each on its own, from all sides, without a pull at what is hidden. Many views end upside down or back to
front, but in many different ways, while those that are right agree to within the range of views. Their mean is how
objects stand, and their spread about it how views differ: more to the sides than in roll, as cameras are held.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import roma
import torch
from torch import Tensor

from articulate_ssl.discovery.registration import register_articulated
from articulate_ssl.discovery.simulated_views import DISTANCE, in_front
from articulate_ssl.geometry.orientation_range import OrientationRange, mean_rotation
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.ops.hidden_points import seen_from_origin
from articulate_ssl.shape.articulated_shape import ArticulatedShape

_COARSE_POINTS, _FINE_POINTS = 128, 256
_COARSE, _FINE = ((0.12, 0.05), 6), ((0.05, 0.03), 4)  # scales and rounds of registration
_SURVIVORS = 30
_ALIKE = 60.0  # degrees: views of upright objects are seldom turned farther from their mean
_ROUNDS = 4
# Views that are drawn spread wider than those that were measured, of which the most turned are missing; and by at least
# so much (radians) about any axis. Chosen, not tuned.
_WIDER, _LEAST_SPREAD = 1.2, math.radians(8)


@dataclass(frozen=True)
class ViewOrientations:
    """How objects are turned in views.

    Attributes:
        mean: [3, 3] canonical object space -> camera.
        covariance: [3, 3] of the rotation vectors, in the camera's frame, from there to single views.
    """

    mean: Tensor
    covariance: Tensor

    def draw(
        self,
        count: int,
        orientation: OrientationRange,
        generator: torch.Generator,
    ) -> Tensor:  # [count, 3, 3]
        """Random rotations of a shape that was turned by the mean, as far as views are, within the range."""
        reach = _WIDER * torch.linalg.cholesky(self.covariance + _LEAST_SPREAD**2 * torch.eye(3).to(self.covariance))
        drawn = []
        while sum(map(len, drawn)) < count:
            vector = torch.randn(count, 3, generator=generator).to(reach) @ reach.T
            rotation = roma.rotvec_to_rotmat(vector)
            drawn.append(rotation[(vector.norm(dim=1) < math.pi) & orientation.contains(rotation)])
        return torch.cat(drawn)[:count]


def find_view_orientations(
    shape: ArticulatedShape,  # as large as in the views
    states: Tensor,  # [Q, J] to start from
    views: Tensor,  # [n, N, 3] depth views
    rotations: Tensor,  # [H, 3, 3] to start from
) -> ViewOrientations:
    """How objects stand before the camera in the mean, and how much views differ from that."""
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
) -> ViewOrientations:
    """Those of the views that agree most, then of each view's best candidate that agrees with their mean."""
    rows = torch.arange(len(rotation))
    best = rotation[rows, error.argmin(dim=1)]
    alike = _degrees(best[:, None], best) < _ALIKE
    mean = mean_rotation(best[alike[alike.sum(dim=1).argmax()]])
    for _ in range(_ROUNDS):
        near = _degrees(rotation, mean) < _ALIKE
        some = near.any(dim=1)
        best = rotation[rows, error.masked_fill(~near, torch.inf).argmin(dim=1)]
        mean = mean_rotation(best[some])
    vector = roma.rotmat_to_rotvec(best[some] @ mean.mT)
    return ViewOrientations(mean, vector.mT @ vector / len(vector))


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
