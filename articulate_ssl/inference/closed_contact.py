"""Where the hinge of a door is: closed, the door lies on its body, neither in it nor before it.

Registration sees how a door is turned and how far its plane is from the hinge; where the door is *in* that plane it
hardly sees, as proportions make up for it, and which part the points about the hinge are of. So hinges were found as
much as a door's thickness from where they are, and doors that were turned back to closed about them were in their
bodies, or hung before them (docs/experiments.md, step 347). Any open cloud shows that: of a door whose points are
turned back it is seen by how much they miss what they would lie on, and the hinge is moved, mostly along the door,
until they do not.

What a closed door lies on need not be known. Seen from the front, in every small cell that shows both, there is a gap
between the door's back and what the body has behind it. Where the door lies on its frame, these gaps are all as wide,
and elsewhere as deep as it comes: the most frequent one tells, unless the door would be in the body then.

Of plates, as a laptop's, faces do not say how they are turned, and explanations have their hinges off in the same way,
across them, too. A gap tells one of both; as it tells another at every angle, training clouds, together, tell both
(`training/contact_lesson.py`), and a cloud what is left.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from articulate_ssl.geometry.screw import REVOLUTE, axis_angle_to_rotation, screw_motion
from articulate_ssl.geometry.se3 import invert_se3, transform_points
from articulate_ssl.inference.late_buffers import LateBuffers
from articulate_ssl.inference.prediction import Prediction

# Lengths are in normalised units; all were chosen on development ovens (docs/experiments.md, step 347).
_CELL = 0.05  # in the door's plane
_REACH, _STEP = 0.12, 0.0025  # gaps that are tried: from the door being so far in the body to so far before it
_ALIKE = 0.01  # standard deviation of gaps that are as wide
_INSIDE = 0.25  # as many cells speak for a gap as it leaves in the body, times so much
_FEWEST = 48  # points of a door, and of a body, with which it is looked at
_CELLS, _TOGETHER = 8, 4  # that show both, and whose gaps are as wide: with fewer it is not known how it closes
# Standard deviations of where hinges are, before: across the door, along it; and of gaps as they are seen.
_ACROSS, _ALONG, _SEEN = 0.007, 0.03, 0.01
_ROUNDS = 30  # of weighing clouds


class ClosedPlates(LateBuffers):
    """Plates that lie on each other when they are closed, as training clouds showed them.

    Attributes:
        learnt: [] whether they do.
        closed: [] joint state at which they are, about.
        off: [2] where hinges are, from where they are predicted: across the plate that moves, and along it (`Contact`).
    """

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("learnt", torch.tensor(False))
        self.register_buffer("closed", torch.tensor(0.0))
        self.register_buffer("off", torch.zeros(2))

    def closing(
        self,
        rest: Tensor,  # [] joint state at which the door of a box is closed
    ) -> tuple[Tensor, Tensor | None]:
        """How `resting_on_bodies` closes what is predicted: the joint state, and of plates where hinges are."""
        return (self.closed, self.off) if self.learnt else (rest, None)


class Contact(NamedTuple):
    """How closed doors lie on their bodies, of B clouds.

    Attributes:
        gap: [B] between them, below 0 where the door is in the body.
        known: [B] bool, whether enough is seen of both.
        directions: [B, 2, 3] unit, camera space: across the door as it is, in the direction in which the body is when
            it is closed, and along it, away from the hinge.
        slope: [B, 2] by how much the gap becomes smaller as the hinge is moved so.
    """

    gap: Tensor
    known: Tensor
    directions: Tensor
    slope: Tensor

    @staticmethod
    def of(
        found: Prediction,  # K = 2, the joint turns
        dense: Tensor,  # [B, P, 3] points that `found.dense_part_id` is of
        closed: Tensor,  # [] joint state at which doors are closed
        plates: bool = False,
    ) -> Contact:
        """Of predictions, about the hinges that they have.

        Args:
            plates: Whether parts are plates, which are parallel when they are closed, whatever joint states say.
        """
        child = int(found.joint_child[0, 0])
        turn = screw_motion(found.joint_axis, found.joint_pivot, closed - found.joint_state, REVOLUTE)[:, 0, :3, :3]
        rows = [
            _seen(cloud - pivot, own == child, axis, back, plates)
            for cloud, own, axis, pivot, back in zip(
                dense, found.dense_part_id, found.joint_axis[:, 0], found.joint_pivot[:, 0], turn, strict=True
            )
        ]
        return Contact(*map(torch.stack, zip(*rows, strict=True)))

    def shift(
        self,
        off: Tensor | None = None,  # [2] where hinges are, of all clouds; None: where they are predicted
    ) -> Tensor:  # [B, 3]
        """Where hinges are to be moved, as is likeliest: by as little as explains the gaps, rather along doors."""
        off = torch.zeros_like(self.slope[0]) if off is None else off.to(self.slope)
        gain = self.slope.new_tensor([_ACROSS, _ALONG]).square() * self.slope
        gain = gain / ((gain * self.slope).sum(dim=1, keepdim=True) + _SEEN**2)
        left = torch.where(self.known, self.gap - self.slope @ off, 0)
        return torch.einsum("bk,bki->bi", off + gain * left[:, None], self.directions)

    def off(self) -> Tensor:  # [2]
        """Where the hinges of all clouds are, together: by which gaps are as wide as they are.

        Clouds whose gap stays count less, as a Cauchy loss has it.
        """
        slope, gap = self.slope[self.known], self.gap[self.known]
        trust, found = torch.ones_like(gap), torch.zeros_like(slope[0])
        for _ in range(_ROUNDS):
            weighted = trust[:, None] * slope
            found = torch.linalg.solve(weighted.mT @ slope + _SEEN**2 * torch.eye(2).to(slope), weighted.mT @ gap)
            trust = 1 / (1 + ((gap - slope @ found) / _SEEN).square())
        return found


def resting_on_bodies(
    found: Prediction,  # K = 2, the joint turns
    dense: Tensor,  # [B, P, 3] points that `found.dense_part_id` is of
    closed: Tensor,  # [] joint state at which doors are closed
    off: Tensor | None = None,  # [2] of plates, see `ClosedPlates`
) -> Prediction:
    """The same parts, as they are turned, about hinges with which closed doors, or plates, lie on their bodies."""
    contact = Contact.of(found, dense, closed, plates=off is not None)
    return _hinged(found, found.joint_pivot[:, 0] + contact.shift(off))


def _hinged(
    found: Prediction,
    pivot: Tensor,  # [B, 3] camera space
) -> Prediction:
    """The same poses and states about a joint line elsewhere: in the canonical shape the part is elsewhere."""
    child, back = int(found.joint_child[0, 0]), invert_se3(found.base_pose)
    at_rest = screw_motion(found.joint_axis, pivot[:, None], -found.joint_state, REVOLUTE)[:, 0]
    assembly = found.assembly.clone()
    assembly[:, child] = transform_points(back @ at_rest, found.part_pose[:, child, None, :3, 3])[:, 0]
    canonical = transform_points(back, pivot[:, None])
    return replace(found, joint_pivot=pivot[:, None], canonical_pivot=canonical, assembly=assembly)


def _seen(
    points: Tensor,  # [P, 3] about the hinge
    own: Tensor,  # [P] bool, the door's
    axis: Tensor,  # [3] unit
    back: Tensor,  # [3, 3] turns the door to closed
    plates: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """See `Contact`, of one cloud."""
    door, body = points[own] @ back.mT, points[~own]
    if min(len(door), len(body)) < _FEWEST:
        none = points.new_zeros(2)
        return none[0], own.new_zeros(()), points.new_zeros(2, 3), none
    plane = torch.linalg.svd(axis[None]).Vh[1:].T  # [3, 2] that the door turns in
    normal, along = _extends(door, plane)
    if plates:
        onto = _extends(body, plane)[0]
        onto = onto * (onto @ normal).sign()
        more = axis_angle_to_rotation(axis, torch.atan2(torch.linalg.cross(normal, onto) @ axis, normal @ onto))
        door, normal, along, back = door @ more.mT, onto, more @ along, more @ back
    normal = normal * (normal @ (body.mean(dim=0) - door.mean(dim=0))).sign()
    along = along * (along @ door.mean(dim=0)).sign()
    closed = torch.stack([normal, along])
    directions = closed @ back  # as the door is
    frame = torch.cat([closed, axis[None]]).T
    gap, known = _most_frequent(_gaps(door @ frame, body @ frame))
    return gap, known, directions, (directions - closed) @ normal


def _extends(
    points: Tensor,  # [p, 3]
    plane: Tensor,  # [3, 2]
) -> Tensor:  # [2, 3] unit
    """The directions in a plane in which points extend least, and most."""
    return (plane @ torch.linalg.eigh(torch.cov((points @ plane).T)).eigenvectors).T


def _gaps(
    door: Tensor,  # [m, 3] first across it, towards the body
    body: Tensor,  # [n, 3]
) -> Tensor:  # [C]
    """In every cell that shows both, by how much the body's nearest point is behind the door's farthest."""
    cells = [(part[:, 1:] / _CELL).floor().long() for part in (door, body)]
    least = cells[0].amin(dim=0)
    size = cells[0].amax(dim=0) - least + 1
    behind = ((cells[1] >= least) & (cells[1] < least + size)).all(dim=1)
    index = [(cell - least) @ torch.stack([size[1], torch.ones_like(size[1])]) for cell in (cells[0], cells[1][behind])]
    count = int(size.prod())
    back = door.new_full((count,), -torch.inf).scatter_reduce(0, index[0], door[:, 0], "amax")
    front = door.new_full((count,), torch.inf).scatter_reduce(0, index[1], body[behind, 0], "amin")
    return (front - back)[(front - back).isfinite()]


def _most_frequent(gaps: Tensor) -> tuple[Tensor, Tensor]:  # [], []
    """How wide most of the narrow ones [C] are, and whether there are enough of them."""
    tried = torch.arange(-_REACH, _REACH + _STEP / 2, _STEP).to(gaps)
    wider = gaps - tried[:, None]
    alike = (wider.square() / (-2 * _ALIKE**2)).exp().sum(dim=1)
    inside = ((-wider - 2 * _ALIKE) / (_ALIKE / 2)).sigmoid().sum(dim=1)
    best = (alike - _INSIDE * inside).argmax()
    return tried[best], (alike[best] >= _TOGETHER) & (len(gaps) >= _CELLS)
