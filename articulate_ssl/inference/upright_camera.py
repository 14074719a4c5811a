"""Which way is up for a camera that is held upright: it sees objects from a range of sides, and not from below.

From cloud to cloud an object turns about its vertical axis, so that is the axis of its box which the camera sees least
spread; where it points to, for the camera, predictions of training clouds say all together. No label is read.

What is explained as lying on its side is an object that stands and is hinged at another side (`hinge_sides`): its frame
is turned by quarters about the door's normal. What stands in none of them, as what lies on its back, is explained
wrongly; and how far an object may be turned (`OrientationRange`) counts once it stands.
"""

from __future__ import annotations

import math

import roma
import torch
from torch import Tensor
from torch.nn import functional

from articulate_ssl.inference.late_buffers import LateBuffers

FEWEST = 60  # clouds from which it is learnt. Chosen.
_TURNS = 4
_ROUNDS = 10  # of the direction that most clouds have in common
_MOST = 0.7  # share of the clouds that it is the mean of: others may lie on their side
# From how far cameras look down differs from cloud to cloud; what is farther off than this is as near to lying as to
# standing. Chosen.
_STANDS = math.radians(40)


class UprightCamera(LateBuffers):
    """Which way is up.

    Attributes:
        learnt: [] whether that is known.
        up: [3] unit, of objects in canonical space.
        vertical: [3] unit, the same as cameras see it on average.
        normal: [3] unit, of the door in canonical space, about which objects are turned until they stand.
    """

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("learnt", torch.tensor(False))
        self.register_buffer("up", torch.zeros(3))
        self.register_buffer("vertical", torch.zeros(3))
        self.register_buffer("normal", torch.zeros(3))

    def forget(self) -> None:
        """As before it was learnt."""
        self.learnt.fill_(False)

    def learn(
        self,
        rotation: Tensor,  # [n, 3, 3] canonical object space -> camera, of training clouds, most of which stand
        axes: Tensor,  # [3, 3] columns: of the object's box, the door's normal last
    ) -> None:
        """Find out which way is up, unless that is where the door's normal points: turns about it then say nothing."""
        self.forget()
        if len(rotation) < FEWEST:
            return
        common = [_common_direction(rotation @ axis) for axis in axes.T]
        least = min(range(3), key=lambda k: float(common[k][1]))
        if least == 2:
            return
        self.up.copy_(axes[:, least])
        self.vertical.copy_(common[least][0])
        self.normal.copy_(axes[:, 2])
        self.learnt.fill_(True)

    def stood(
        self,
        rotation: Tensor,  # [..., 3, 3] canonical object space -> camera
    ) -> tuple[Tensor, Tensor, Tensor]:  # [..., 3, 3], [...], [...] bool
        """Frames turned about the normal until they stand best, by how many quarters, and whether they stand then."""
        turns = roma.rotvec_to_rotmat(torch.arange(_TURNS).to(rotation)[:, None] * (math.pi / 2) * self.normal)
        turns = turns.to(rotation)
        seen = torch.einsum("...ij,tj->...ti", rotation, turns @ self.up.to(rotation))
        angle, quarters = (seen @ self.vertical.to(rotation)).clamp(-1, 1).arccos().min(dim=-1)
        return rotation @ turns[quarters], quarters, angle < _STANDS


def _common_direction(
    directions: Tensor,  # [n, 3] unit
) -> tuple[Tensor, Tensor]:  # [3] unit, []
    """The mean of the directions but for those farthest from it, and the median angle to it."""
    mean = directions.mean(dim=0)
    for _ in range(_ROUNDS):
        cosine = directions @ functional.normalize(mean, dim=0)
        mean = directions[cosine >= cosine.quantile(1 - _MOST)].mean(dim=0)
    mean = functional.normalize(mean, dim=0)
    return mean, (directions @ mean).clamp(-1, 1).arccos().median()
