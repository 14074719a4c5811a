"""How parts are turned, from the directions of their faces: most of an oven is square to itself, and so is its door.

Registration turns a part to where its points fit best, and the category's shape fits an object of other proportions a
few degrees off. Faces do not depend on proportions: the normals of a box, or of a plate, say to a fraction of a degree
how it is turned, up to the 24 rotations of the cube, between which registration has decided. So of parts that have
faces, the root is turned until it is square to them (a Manhattan frame, as of the whole cloud in
`discovery.manhattan_frame`), and the joints of the others go to the states in which they are.

Which parts have faces, and how these lie in canonical space, predictions of training clouds say, all together; and as
two parts with faces are turned against each other about the joint between them, they say about which direction that is:
of a box and what turns on it, by how faces move; of two plates, whose hinge lies in both, by what all are square
to. No label is read.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import roma
import torch
from torch import Tensor
from torch.nn import functional

from articulate_ssl.geometry.se3 import se3
from articulate_ssl.inference.late_buffers import LateBuffers
from articulate_ssl.network.hypotheses import Hypotheses
from articulate_ssl.ops.chamfer import nearest_distance

_MEASURED = 256  # points of a part at which there are normals
# Standard deviation, in normalised units, of the window that looks at the part's surface about each. Plates are
# thinner than that is wide: their two faces are one. Of a door that bulges, the wider one sees the whole.
WINDOWS = (0.05, 0.2)
# Least by largest but one variance of neighbours: beyond the first there is no face, and well below the second all
# count alike.
_CURVED, _FLAT = 0.3, 0.01
_REACH = (20.0, 6.0)  # degrees: a normal farther from every axis does not count, in the first round and in the last
_ROUNDS = 8
_PRIOR = 0.02  # of what normals weigh, weighs how the part was turned: that decides what they leave open
FARTHEST = 20.0  # degrees that faces may turn a part by on their word alone
# A joint may be farther off: where parts are shorter than the category's, as doors beside a panel, registration turns
# them until their ends are where they should be. So faces are also asked from here, in degrees; those that are halfway
# to the next quarter turn are as near to that.
_STARTS, _HALFWAY = (0.0, -25.0, 25.0), 45.0
_FEWEST = 20  # faces that say how it is turned
_LESSONS = 4  # rounds of squaring parts to their faces, and of seeing where these lie
_TOGETHER, _SHARE = 12.0, 0.8  # a part has faces if in so many clouds they are so near, in degrees, to where most are
_SQUARE, _MOST = 5.0, 10.0  # degrees: mean angle of normals to axes in the median cloud; each counts as at most so much
# Of the faces of a box, so many are square to either axis but the first; a plate has nearly none. Boxes that were seen
# have .16 and more, plates .01 and less.
_BOX = 0.05
_PARALLEL = 5.0  # degrees: a joint that is so near to an axis of the box that it is on is parallel to that
# Degrees: two plates say about which direction they turn if the normals of most clouds are so nearly square to it (of
# laptops .1), and are turned against each other by so much: of parallel ones any direction in them is square to both.
_SQUARE_TO_JOINT, _TURNED = 1.0, 15.0


class PartFrames(LateBuffers):
    """Of a category's parts, in canonical object space at joint states zero.

    Attributes:
        flat: [K] whether faces say how a part is turned; none until it is learnt.
        wide: [K] whether they do in the wider window alone.
        axes: [K, 3, 3] columns, at right angles, that faces are square to; of all parts, so that parts stretch along
            them.
        measured: [J] whether it is known about which direction joints turn; elsewhere the network's word stays.
        direction: [J, 3] unit, of those.
    """

    def __init__(self, num_parts: int) -> None:
        """Args: K."""
        super().__init__()
        self.register_buffer("flat", torch.zeros(num_parts, dtype=torch.bool))
        self.register_buffer("wide", torch.zeros(num_parts, dtype=torch.bool))
        self.register_buffer("axes", torch.eye(3).repeat(num_parts, 1, 1))
        self.register_buffer("measured", torch.zeros(num_parts - 1, dtype=torch.bool))
        self.register_buffer("direction", torch.zeros(num_parts - 1, 3))

    @property
    def learnt(self) -> bool:
        """Whether faces say anything."""
        return bool(self.flat.any())

    def learn(
        self,
        one: Hypotheses,  # H = 1, of n clouds, whose joints turn
        windows: tuple[Faces, Faces],  # as seen in either window
        start: Tensor,  # [K, 3, 3] columns, right-handed: roughly the axes
    ) -> Tensor:  # [K, 2]
        """Find out which parts have faces, how these lie, and about which directions joints turn.

        Where the root has none, nothing is learnt: about a line that is a few degrees off, faces turn other parts to
        wrong states. Other parts that have none in the narrow window may have one in the wide one.

        Returns:
            Of every part the share of clouds in which its faces lie where most do, and how square they are (degrees).
        """
        chain = one.chain
        flat, found, quality, faces = [], [], [], windows[0]
        for part in range(chain.num_parts):
            for wide in (False, True) if part != chain.root else (False,):
                frame, *some = self._lie(one, part, windows[wide].of(part), start[part])
                clear = bool(some[0] > _SHARE and some[1] < _SQUARE)
                self.wide[part] = wide and clear
                if clear:
                    break
            flat.append(clear)
            found.append(frame)
            quality.append(torch.stack(some))
            faces = faces.with_part(part, windows[int(self.wide[part])])
        self.flat.copy_(torch.tensor(flat) & flat[chain.root])
        self.measured.fill_(False)
        for joint, (parent, child) in enumerate(zip(chain.parent, chain.child, strict=True)):
            body, part = faces.of(parent), faces.of(child)
            if not self.flat[parent]:
                continue
            direction = functional.normalize(one.axis[:, 0, joint].mean(dim=0), dim=0)
            if body.along(found[parent]).mean(dim=0).median() < _BOX:
                if self.flat[child]:
                    self._measure_plates(joint, (parent, body, found[parent]), (part, found[child]), direction)
                continue
            if self.flat[child]:
                seen = self.axes[parent] @ found[parent].mT @ found[child]
                known = body.enough & part.enough
                direction = _common_axis(seen[known], part.along(found[child])[known], direction)
            cosine = self.axes[parent].T @ direction
            nearest = cosine.abs().argmax()
            if cosine[nearest].abs() > math.cos(math.radians(_PARALLEL)):
                direction = self.axes[parent][:, nearest] * cosine[nearest].sign()
            self.direction[joint], self.measured[joint] = direction, True
        return torch.stack(quality)

    def _measure_plates(
        self,
        joint: int,
        body: tuple[int, Faces, Tensor],  # the plate that it is on, its faces, and its axes in camera space [n, 3, 3]
        part: tuple[Faces, Tensor],  # the same of the plate that it turns
        believed: Tensor,  # [3] unit
    ) -> None:
        """Measure the direction of a joint between plates: that which the normals of both are square to."""
        (parent, faces, frame), (own, turning) = body, part
        known = faces.enough & own.enough
        if not known.any():
            return
        sides = [int(some.along(at)[known].mean(dim=0).argmax()) for some, at in ((faces, frame), part)]
        fixed = self.axes[parent][:, sides[0]]
        moving = (self.axes[parent] @ frame.mT @ turning)[known][:, :, sides[1]]
        direction, off = _square_to_all(fixed, moving, believed)
        turned = (moving @ fixed).abs().clamp(max=1).acos().rad2deg().median()
        near = believed @ direction > math.cos(math.radians(FARTHEST))
        if near and off < _SQUARE_TO_JOINT and turned > _TURNED:
            self.direction[joint], self.measured[joint] = direction, True

    def about_joint(self, part: int) -> Tensor:  # [3, 3] columns
        """A part's axes, that which is nearest to the direction of the first joint turned to it, and first."""
        axes, first = self.axes[part], self.direction[0]
        cosine = axes.T @ first
        nearest = int(cosine.abs().argmax())
        axis = axes[:, nearest] * cosine[nearest].sign()
        turn = torch.linalg.cross(axis, first)
        turn = turn / turn.norm().clamp(min=1e-9) * torch.atan2(turn.norm(), axis @ first)
        others = roma.rotvec_to_rotmat(turn) @ axes[:, [k for k in range(3) if k != nearest]]
        return torch.cat([first[:, None], others], dim=1)

    def settled(
        self,
        one: Hypotheses,  # H = 1
        dense: Tensor,  # [B, P, 3]
        afar: bool = False,
        part: Tensor | None = None,  # [B, P]
    ) -> tuple[Hypotheses, tuple[Tensor, Tensor]]:  # H = 1, ([B], [B, J])
        """Explanations turned as the faces of clouds say, and whether they do: of the whole, and of every joint.

        Faces turn the whole by at most 20 degrees, and joints likewise; `afar` joints by up to 45, if nothing nearer is
        square to them: whoever asks for that has to see whether it explains the cloud.

        Args:
            part: Which one points are of, where that is known; None: the one that is nearest.
        """
        axis = torch.where(self.measured[:, None], self.direction, one.axis)
        one = replace(one, structure=replace(one.structure, axis=axis))
        windows = [WINDOWS[int(wide)] for wide in self.wide]
        one, turned = self._root_squared(one, faces_of(one, dense, windows, part).of(one.chain.root))
        one, moved = self._joints_squared(one, faces_of(one, dense, windows, part), afar)
        return one, (turned, moved)

    def _lie(
        self, one: Hypotheses, part: int, faces: Faces, axes: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:  # [n, 3, 3], [], []
        """See `learn`, of one part: how clouds' own axes are turned, in camera space, the share, and how square."""
        pose, root = one.object_pose()[:, 0, part, :3, :3], part == one.chain.root
        joint = 0 if root else one.chain.child.index(part)
        line = one.axis[:, 0, joint]
        for _ in range(_LESSONS):
            frame = pose @ axes
            if not root:
                by = _squared_about((pose @ line[..., None]).squeeze(-1), frame, faces)
                frame = pose @ roma.rotvec_to_rotmat(line * by[:, None]) @ axes
            frame, angle = square_to(frame, faces)
            if root:
                axes, near = _where_most_are(pose.mT @ frame, faces.enough)
            else:  # in its own plane a plate is not known to lie: only how it is turned about its joint counts
                middle, near = _where_most_turn(by, faces.enough)
                axes = roma.rotvec_to_rotmat(functional.normalize(line.mean(dim=0), dim=0) * middle) @ axes
        self.axes[part] = axes
        if not faces.enough.any():
            return frame, angle.new_zeros(()), angle.new_tensor(_MOST)
        return frame, near[faces.enough].float().mean(), angle[faces.enough].median()

    def _root_squared(
        self,
        one: Hypotheses,  # H = 1
        faces: Faces,  # of the root
    ) -> tuple[Hypotheses, Tensor]:  # H = 1, [B]
        """Explanations turned about the middle of their root until it is square to its faces, and which were."""
        root, old = one.chain.root, one.base[:, 0, :3, :3]
        new = square_to(old @ self.axes[root], faces)[0] @ self.axes[root].mT
        turned = faces.enough & (roma.rotmat_geodesic_distance(new, old) < math.radians(FARTHEST))
        new = torch.where(turned[:, None, None], new, old)
        middle = one.object_shape()[:, root].mean(dim=1, keepdim=True)
        place = one.base[:, 0, :3, 3] + (middle @ (old - new).mT).squeeze(1)
        return one.at(se3(new, place)[:, None], one.state), turned

    def _joints_squared(
        self,
        one: Hypotheses,  # H = 1
        faces: Faces,
        afar: bool,
    ) -> tuple[Hypotheses, Tensor]:  # H = 1, [B, J]
        """Explanations with joints in the states in which parts are square to their faces, and which were."""
        moved = torch.zeros_like(one.state[:, 0], dtype=torch.bool)
        for joint, part in enumerate(one.chain.child):
            if not self.flat[part]:
                continue
            pose, own = one.object_pose()[:, 0, part, :3, :3], faces.of(part)
            axis = (pose @ one.axis[:, 0, joint, :, None]).squeeze(-1)
            look = _squared_from_afar if afar else _squared_about
            angle = look(axis, pose @ self.axes[part], own)
            moved[:, joint] = own.enough & (angle.abs() < math.radians(_HALFWAY if afar else FARTHEST))
            state = one.state.clone()
            state[:, 0, joint] += torch.where(moved[:, joint], angle, 0)
            one = one.at(one.base, state)
        return one, moved


class Faces(NamedTuple):
    """Normals of B clouds, and how much each counts, by part.

    Attributes:
        normal: [B, K, m, 3] unit, up to sign; of one part [B, m, 3].
        weight: [B, K, m]; likewise.
    """

    normal: Tensor
    weight: Tensor

    def of(self, part: int) -> Faces:
        """Those of one part."""
        return Faces(self.normal[:, part], self.weight[:, part])

    def with_part(self, part: int, other: Faces) -> Faces:
        """The same, of one part as others have them."""
        normal, weight = self.normal.clone(), self.weight.clone()
        normal[:, part], weight[:, part] = other.normal[:, part], other.weight[:, part]
        return Faces(normal, weight)

    @property
    def enough(self) -> Tensor:
        """[B] whether there are enough to tell how one part is turned."""
        return (self.weight > 0).sum(dim=1) >= _FEWEST

    def along(
        self,
        frame: Tensor,  # [B, 3, 3] columns
    ) -> Tensor:  # [B, 3]
        """Shares of those that are square to each axis, of all that are square to any."""
        to_axis = _nearest_axis(frame, self.normal, torch.tensor(_REACH[1]).deg2rad())
        count = torch.einsum("bm,bmi->bi", self.weight, to_axis.abs())
        return count / count.sum(dim=1, keepdim=True).clamp(min=1e-6)


def faces_of(
    one: Hypotheses,  # H = 1
    dense: Tensor,  # [B, P, 3]
    windows: Sequence[float],  # of every part
    part: Tensor | None = None,  # [B, P]
) -> Faces:
    """Normals of clouds, by the part that points are of, or else by that of their explanations that is nearest."""
    if part is None:
        posed = one.posed()[:, 0]
        part = torch.stack([nearest_distance(dense, posed[:, k]) for k in range(posed.shape[1])]).argmin(dim=0)
    found = [
        [_normals(cloud[own == k], window) for k, window in enumerate(windows)]
        for cloud, own in zip(dense, part, strict=True)
    ]
    normal, weight = (
        torch.stack([torch.stack(parts) for parts in some])
        for some in zip(*([*zip(*parts, strict=True)] for parts in found), strict=True)
    )
    return Faces(normal, weight)


def square_to(
    frame: Tensor,  # [B, 3, 3] columns
    faces: Faces,
) -> tuple[Tensor, Tensor]:  # [B, 3, 3], [B]
    """Frames turned until normals are along their axes, and the mean angle (degrees, capped) of those to them.

    As in `manhattan_frames`, but near where they are: every normal pulls the axis that is nearest, if one is near.
    """
    start, weight = frame, faces.weight[..., None]
    prior = _PRIOR * faces.weight.sum(dim=1)[:, None, None] + 1e-6
    for reach in torch.linspace(*_REACH, _ROUNDS).deg2rad():
        to_axis = _nearest_axis(frame, faces.normal, reach)
        frame = roma.special_procrustes(torch.einsum("bmi,bmj->bij", weight * faces.normal, to_axis) + prior * start)
    return frame, _off_square(frame, faces)


def _off_square(frame: Tensor, faces: Faces) -> Tensor:
    """Mean angles [B] (degrees, capped) of normals to the nearest axes of frames [B, 3, 3]."""
    cosine = torch.einsum("bij,bmi->bmj", frame, faces.normal).abs().amax(dim=-1).clamp(max=1)
    angle = cosine.acos().rad2deg().clamp(max=_MOST)
    return (faces.weight * angle).sum(dim=1) / faces.weight.sum(dim=1).clamp(min=1e-6)


def _squared_from_afar(
    axis: Tensor,  # [B, 3] unit
    frame: Tensor,  # [B, 3, 3] columns
    faces: Faces,
) -> Tensor:  # [B] radians
    """As `_squared_about`, from farther away, too: the least turn after which normals are square to frames.

    If there is none, by how much normals within reach turn them. Normals along the axis are square however they turn.
    """
    across = (faces.normal @ axis[..., None]).squeeze(-1).abs() < math.sqrt(0.5)
    telling = faces._replace(weight=faces.weight * across)
    found = []
    for start in torch.tensor(_STARTS).deg2rad().to(axis):
        angle = start + _squared_about(axis, _turned(frame, axis, start.expand(len(axis))), faces)
        square = telling.enough & (_off_square(_turned(frame, axis, angle), telling) < _SQUARE)
        found.append(torch.stack([angle, torch.where(square, angle.abs(), torch.inf)]))
    angle, turn = torch.stack(found, dim=1)
    least = turn.argmin(dim=0, keepdim=True)  # the first if none is square
    return angle.gather(0, least)[0]


def _turned(frame: Tensor, axis: Tensor, angle: Tensor) -> Tensor:
    """Frames [B, 3, 3] about axes [B, 3] by angles [B]."""
    return roma.rotvec_to_rotmat(axis * angle[:, None]) @ frame


def _squared_about(
    axis: Tensor,  # [B, 3] unit
    frame: Tensor,  # [B, 3, 3] columns
    faces: Faces,
) -> Tensor:  # [B] radians
    """By how much frames are turned about an axis until normals are along theirs (`square_to`)."""
    total = torch.zeros_like(axis[:, 0])
    along = (faces.normal @ axis[..., None]).squeeze(-1)
    for reach in torch.linspace(*_REACH, _ROUNDS).deg2rad():
        turned = _turned(frame, axis, total)
        target = torch.einsum("bij,bmj->bmi", turned, _nearest_axis(turned, faces.normal, reach))
        sine = (torch.linalg.cross(target, faces.normal) @ axis[..., None]).squeeze(-1)
        cosine = (target * faces.normal).sum(dim=-1) - along * (target @ axis[..., None]).squeeze(-1)
        total = total + torch.atan2((faces.weight * sine).sum(dim=1), (faces.weight * cosine).sum(dim=1) + 1e-6)
    return total


def _nearest_axis(frame: Tensor, normal: Tensor, reach: Tensor) -> Tensor:
    """In frames [B, 3, 3], the axes [B, m, 3] that normals [B, m, 3] are along but for the sign; 0 if none is near."""
    seen = torch.einsum("bij,bmi->bmj", frame, normal)
    largest = seen.abs().amax(dim=-1, keepdim=True)
    return seen.sign() * (seen.abs() == largest) * (largest > reach.cos())


def _normals(points: Tensor, window: float) -> tuple[Tensor, Tensor]:
    """Of a part [p, 3] the normals of its surface at some points [m, 3], and how much they count [m]."""
    normal, weight = points.new_zeros(_MEASURED, 3), points.new_zeros(_MEASURED)
    if len(points) < 2 * _FEWEST:
        return normal, weight
    at = torch.linspace(0, len(points) - 1, min(_MEASURED, len(points))).long().to(points.device)
    seen = (torch.cdist(points[at], points).square() / (-2 * window**2)).exp()
    seen = seen / seen.sum(dim=1, keepdim=True)
    mean, square = seen @ points, seen @ (points[:, :, None] * points[:, None]).flatten(1)
    variance, directions = torch.linalg.eigh(square.unflatten(1, (3, 3)) - mean[:, :, None] * mean[:, None])
    thickness = variance[:, 0].clamp(min=0) / variance[:, 1].clamp(min=1e-12)
    normal[: len(at)] = directions[..., 0]
    weight[: len(at)] = (thickness < _CURVED) / (thickness + _FLAT)
    return normal, weight


def _where_most_are(
    frames: Tensor,  # [n, 3, 3]
    known: Tensor,  # [n] bool
) -> tuple[Tensor, Tensor]:  # [3, 3], [n]
    """The mean of the frames that most are near to, and which these are."""
    distance = roma.rotmat_geodesic_distance(frames[:, None], frames).rad2deg()
    middle = (distance.clamp(max=_TOGETHER) * known).sum(dim=1).argmin()
    near = known & (distance[middle] < _TOGETHER)
    return roma.special_procrustes(frames[near].sum(dim=0) + 1e-6 * frames[middle]), near


def _where_most_turn(
    angle: Tensor,  # [n] radians
    known: Tensor,  # [n] bool
) -> tuple[Tensor, Tensor]:  # [], [n]
    """The mean of the angles that most are near to, and which these are."""
    apart, reach = (angle[:, None] - angle).abs(), math.radians(_TOGETHER)
    middle = (apart.clamp(max=reach) * known).sum(dim=1).argmin()
    near = known & (apart[middle] < reach)
    return angle[near].mean() if near.any() else angle[middle], near


def _square_to_all(
    fixed: Tensor,  # [3] unit
    moving: Tensor,  # [n, 3] unit
    start: Tensor,  # [3] unit
) -> tuple[Tensor, Tensor]:  # [3] unit, []
    """The direction that a normal and all others are square to, and how far from it most of these are, in degrees."""
    trust, axis = moving.new_ones(len(moving)), start
    for _ in range(_ROUNDS):
        weighted = (trust[:, None] * moving).mT @ moving + trust.sum() * torch.outer(fixed, fixed)
        least = torch.linalg.eigh(weighted).eigenvectors[:, 0]
        axis = least * (least @ axis).sign()
        trust = 1 / ((moving @ axis).square() + math.radians(1) ** 2)
    return axis, (moving @ axis).abs().clamp(max=1).asin().rad2deg().median()


def _common_axis(
    turned: Tensor,  # [n, 3, 3] columns, as they turn about one direction
    share: Tensor,  # [n, 3] of what says where these are
    start: Tensor,  # [3]
) -> Tensor:  # [3] unit
    """The direction: columns that turn about it stay at the same angle to it.

    Of a plate its normal is known, and how it lies in its own plane is not, so columns count as faces are square to
    them. Clouds in which they do not stay count less, as a Cauchy loss has it.
    """
    axis, column, trust = start, turned.mT, turned.new_ones(len(turned))
    for _ in range(_ROUNDS):
        weight = (trust[:, None] * share)[..., None]  # [n, 3, 1]
        off = column - (weight * column).sum(dim=0) / weight.sum(dim=0).clamp(min=1e-6)
        least = torch.linalg.eigh(torch.einsum("nci,ncj->ij", weight * off, off)).eigenvectors[:, 0]
        axis = least * (least @ axis).sign()
        trust = 1 / ((share * (off @ axis).square()).sum(dim=1) + math.radians(1) ** 2)
    return axis
