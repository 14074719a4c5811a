"""How the objects of depth views are turned, relative to a shape that was found in complete clouds.

Complete clouds stand in any orientation: nothing in them says how a camera was held. The views do: each is compared
with simulated views of many objects from all sides. Most of those that are like it are turned otherwise, a chest of
drawers from behind like one from the front; but otherwise in many ways, while those that are right agree to within the
range of views. Their mean is how objects stand, and their spread about it how views differ: more to the sides than in
roll, as cameras are held.

To register one shape to the views instead is no good where objects differ: a chest that stands on its side fits a wide
view better than a tall chest does that stands as it should (docs/experiments.md, step 93).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import roma
import torch
from torch import Tensor

from articulate_ssl.discovery.registration import register_rigid
from articulate_ssl.geometry.orientation_range import OrientationRange, mean_rotation
from articulate_ssl.ops.chamfer import nearest_distance

_POINTS = 128  # of each view
_NEAREST = 30  # simulated views to which a view is registered
_SCALES, _STEPS = (0.1, 0.04), 6  # of that registration
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
    views: Tensor,  # [n, N, 3] depth views
    simulated: Tensor,  # [s, M, 3] views of objects of the category from all sides
    rotation: Tensor,  # [s, 3, 3] canonical object space -> camera in each
) -> ViewOrientations:
    """How objects stand before the camera in the mean, and how much views differ from that."""
    sides, found, errors = simulated[:, :_POINTS].contiguous(), [], []
    for view in views[:, :_POINTS]:
        copies = view.expand(len(sides), -1, -1)
        distance = nearest_distance(copies, sides).mean(dim=1) + nearest_distance(sides, copies).mean(dim=1)
        nearest = distance.topk(min(_NEAREST, len(sides)), largest=False).indices
        turn, error = register_rigid(view, sides[nearest], torch.eye(3).to(view)[None], 1, _SCALES, _STEPS)
        found.append(turn[:, 0, :3, :3].mT @ rotation[nearest])
        errors.append(error[:, 0])
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


def _degrees(a: Tensor, b: Tensor) -> Tensor:
    return roma.rotmat_geodesic_distance(*torch.broadcast_tensors(a, b)).rad2deg()
