"""Boxes whose door is hinged at another side than that of most objects: one oven in nine is, one safe in sixteen.

A category has one joint. An oven that is hinged at its side is explained as well by one that lies on its side, hinged
below, and only the body tells which it is. So of a prediction everything in camera space stays, and its frame is turned
about the door's normal, by a quarter or half a turn, if the body looks as those of most objects do when it is seen so.
(Where looks say how boxes stand, they are explained as they stand, hinged elsewhere: `other_hinge`, `square_search`.)

A network says how right the body looks (`surface_decision`). It learns that from predictions, most of which are right,
and without labels; the few that are wrong it would learn as well, if it could tell by anything where the hinge is. So
it sees nothing of that: frames are each cloud's own axes at right angles (`manhattan_frame`), which differ by exact
quarter turns, and of the points only those that lie behind the closed door's plane.

Some bodies themselves seem to tell where the hinge is, as the opening of a safe leaves room for it at one side
(docs/experiments.md, step 170). But of a safe the lock is above the handle. Where a door is hinged on the other side,
objects are explained upside down; and who sees every door in the mirror as often as it is does not know at which side
its hinge is. So there doors are seen, each in its own frame, as they are and in the mirror, and half turns are told.
A door that is shown alone is seen from near: by it four in five of the wrong ones are found, by as many points of
whole safes, of which a seventh are the door's, it was a third (step 217).

A camera that is held upright knows which way is up (`upright_camera`); in its views no network is asked.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import roma
import torch
from scipy.spatial import ConvexHull
from torch import Tensor
from torch.nn import functional

from articulate_ssl.discovery.manhattan_frame import manhattan_frames
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.geometry.screw import REVOLUTE, screw_motion
from articulate_ssl.geometry.se3 import invert_se3, transform_points
from articulate_ssl.inference.part_frames import PartFrames
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.inference.surface_decision import LOOKS, WithSurface, surface_alone
from articulate_ssl.inference.upright_camera import UprightCamera
from articulate_ssl.network.surface_network import SurfaceCloud, SurfaceSize
from articulate_ssl.ops.spin_images import SPIN_CHANNELS
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.object_axes import object_axes

TURNS = 4  # quarter turns: sides that a door may be hinged at
# What reads bodies; more points were not tried to the end (docs/experiments.md, step 133).
BODY_SIZE = SurfaceSize(read=256, centers=128)
DOOR_SIZE = SurfaceSize(read=384, centers=192)
_FEWEST_POINTS = 256  # of a door, with which it is looked at. Chosen.
_ROOM = 0.02  # before and behind a door, in normalised units. Chosen.
_PLANES = 3  # times that a door's plane is found, and its points by that. Chosen.
# Behind the closed door's plane, in normalised units. With .04 fewer are found (docs/experiments.md, step 124).
_BEHIND = 0.12
# By how much likelier, as a logarithm, a body has to look when it is turned: what is less is undecided, and stays. The
# network of bodies is taught without doubt, and surer than it is right: a dishwasher, whose like no lesson showed, it
# turned upside down in half of its clouds, by .6 to 1.5; most ovens are told by 10 and more (step 227). Chosen earlier,
# for lessons, of which it says what they leave undecided.
DECIDED = 2.0
# Of so many points about one of a door, the share of the door's below which it is taken for a stray one. Chosen.
_NEIGHBOURS, _STRAY = 16, 0.3
_CLOSED_REACH = math.radians(120)  # from the middle of the joint's range: the closed door is not farther. Chosen.

log = logging.getLogger(__name__)


class Bodies(NamedTuple):
    """What is seen of B bodies without their doors, in V versions of their clouds; or of their doors alone.

    Attributes:
        points: [V, B, S, 3] camera space; S is what the network reads in all its looks.
        surface: [V, B, S, SPIN_CHANNELS + 3] spin images and normals, in float16.
        frames: [B, TURNS, 3, 3] frame -> camera: of the box, or the door, as it is predicted, hinge first and door's
            normal last, and the same turned about the latter by one, two and three quarters.
        normal: [B, 3] of the closed door, camera space, about which objects are turned.
        known: [B] whether enough is seen of it.
    """

    points: Tensor
    surface: Tensor
    frames: Tensor
    normal: Tensor
    known: Tensor

    def rows(self, rows: Tensor) -> Bodies:
        """Some of them."""
        return Bodies(self.points[:, rows], self.surface[:, rows], *(one[rows] for one in self[2:]))

    @staticmethod
    def cat(several: Iterable[Bodies]) -> Bodies:
        """All of them."""
        points, surface, *rest = zip(*several, strict=True)
        return Bodies(torch.cat(points, dim=1), torch.cat(surface, dim=1), *(torch.cat(one) for one in rest))


class HingeSides(WithSurface):
    """At which side objects are hinged, in quarter turns about the door's normal from where most are.

    Of W ways there are `TURNS`, or as it is and upside down where doors are seen.

    Args:
        whole: Whether clouds show all sides.

    Attributes:
        doors: [] whether doors are seen, also in the mirror, and not bodies.
        learnt: [] whether some objects are hinged elsewhere. Then joint states count from `closed`.
        closed: [] joint state at which the door is closed, of predictions before; the middle of the states that were
            seen once half turns alone are told, as mirror images are closed by as much.
        axes: [3, 3] columns: of the object's box in canonical space, the door's normal last, pointing at the body.
        shut: [] joint state at which the door is closed, as predictions count it when doors are seen.
        door: [3] canonical space, the middle of the closed door.
        log_prior: [TURNS] logarithm of the share of objects that are to be turned so; as many as there are ways count.
        surface: How right a body, or a door, looks.
        camera: Which way is up, for a camera that is held upright.
    """

    def __init__(self, whole: bool = True) -> None:
        super().__init__()
        self.whole = whole
        self.camera = UprightCamera()
        self.register_buffer("learnt", torch.tensor(False))
        self.register_buffer("doors", torch.tensor(False))
        self.register_buffer("closed", torch.tensor(0.0))
        self.register_buffer("shut", torch.tensor(0.0))
        self.register_buffer("axes", torch.eye(3))
        self.register_buffer("door", torch.zeros(3))
        self.register_buffer("log_prior", torch.zeros(TURNS))

    def _load_from_state_dict(self, state_dict: dict, prefix: str, *rest) -> None:
        if state_dict.pop(f"{prefix}whole", False):
            log.warning("what whole clouds taught of which side is up, until 2026-11-26, is left out: teach it again")
            for name in [name for name in state_dict if name.startswith(prefix)]:
                del state_dict[name]
        super()._load_from_state_dict(state_dict, prefix, *rest)

    @property
    def size(self) -> SurfaceSize:
        """Of the network that was taught, or is to be."""
        if self.surface is not None:
            return self.surface.size
        return DOOR_SIZE if self.doors else BODY_SIZE

    @property
    def quarters(self) -> Tensor:  # [W]
        """By how many quarters the ways are turned."""
        return torch.arange(0, TURNS, 2 if self.doors else 1, device=self.closed.device)

    @property
    def hinges(self) -> Tensor:  # [W, 3, 3]
        """Turns of hinges about the door's normal, in the canonical space of objects that are turned so."""
        return roma.rotvec_to_rotmat(self.quarters[:, None] * (-math.pi / 2) * self.axes[:, 2])

    def hinged(self, axis: Tensor) -> Tensor:  # [B]
        """In which of the ways joints with axes [B, 3] are hinged, in canonical space."""
        return (axis @ (self.hinges @ self.axes[:, 0]).mT.to(axis)).argmax(dim=1)

    def measure(self, shape: ArticulatedShape, state_range: Tensor, frames: PartFrames | None = None) -> None:
        """Find axes and the closed door of a category's shape with one joint.

        Args:
            state_range: [1, 2] joint states that were seen.
            frames: How the faces of its parts lie; where that is known, they are squarer than boxes about points.
        """
        root, child = shape.joints.chain.root, shape.joints.chain.child[0]
        shape, axes, own = _boxes(shape, frames)
        closed, hinge = _closed_state(shape, axes, own, state_range), axes[:, 0]
        door = _at(shape, child, closed)
        middle = (door.amax(dim=0) + door.amin(dim=0)) / 2
        extent = (door @ axes).amax(dim=0) - (door @ axes).amin(dim=0)
        normal = axes[:, 1 + int(extent[1:].argmin())]
        normal = normal * ((shape.part(root).mean(dim=0) - middle) @ normal).sign()
        self.closed.fill_(closed)
        self.shut.fill_(closed)
        self.axes.copy_(torch.stack([hinge, torch.linalg.cross(normal, hinge), normal], dim=1))
        self.door.copy_(middle)

    def counted_from_closed(self, prediction: Prediction) -> Prediction:
        """The same with joint states that count from the closed door, where all parts are turned as the object is.

        So frames of parts mean the same whichever side the door is hinged at.
        """
        closed = self.closed.to(prediction.joint_state)
        motion = screw_motion(prediction.canonical_axis, prediction.canonical_pivot, closed, REVOLUTE)[:, 0]
        child, back = int(prediction.joint_child[0, 0]), motion[:, :3, :3].mT
        pose, shape, assembly = (x.clone() for x in (prediction.part_pose, prediction.part_shape, prediction.assembly))
        pose[:, child, :3, :3] = pose[:, child, :3, :3] @ back
        shape[:, child] = shape[:, child] @ back
        assembly[:, child] = transform_points(motion, assembly[:, child, None])[:, 0]
        state = prediction.joint_state - closed
        return replace(prediction, part_pose=pose, part_shape=shape, assembly=assembly, joint_state=state)

    def decided(
        self,
        prediction: Prediction,  # joint states count from the closed door
        dense: Tensor | None,  # [B, P, 3]
    ) -> tuple[Prediction, Tensor]:  # , [B]
        """The same, its frame turned so that it stands, or what is seen of it looks right.

        Its margin is at most how sure it is that it does. Where too little is seen of it, nothing is decided; bodies
        that look hardly more right in another way stay, too, with a margin of 0.

        Returns:
            That, and by how many quarters frames were turned.
        """
        if self.camera.learnt:
            rotation = prediction.base_pose[:, :3, :3]
            quarters = self.camera.stood(rotation)[1]
            return turned_about(prediction, rotation @ self.camera.normal.to(rotation), quarters), quarters
        if dense is None or dense.shape[1] < LOOKS * self.size.read:
            return prediction, torch.zeros_like(prediction.joint_parent[:, 0])
        bodies = self.bodies(prediction, dense, (dense,))
        count = len(self.quarters)
        hinged = self.hinged(prediction.canonical_axis[:, 0])
        # What is hinged elsewhere as it stands is turned to where its hinge is rarer, or more usual.
        every = (hinged[:, None] + torch.arange(count, device=dense.device)) % count
        odds = self.looks_right(bodies) + self.log_prior.to(dense)[every]
        best, ways = odds.topk(2, dim=1)
        undecided = (ways[:, 0] > 0) & (best[:, 0] - odds[:, 0] < (0.0 if self.doors else DECIDED))
        sure = torch.where(undecided, 0.0, (best[:, 0] - best[:, 1]) / (2 * self.surface.temperature))
        sure = torch.where(bodies.known, sure, torch.inf).tanh()
        quarters = torch.where(bodies.known & ~undecided, self.quarters[ways[:, 0]], 0)
        turned = turned_about(prediction, bodies.normal, quarters)
        return replace(turned, margin=prediction.margin.minimum(sure)), quarters

    def looks_right(self, bodies: Bodies) -> Tensor:  # [B, W]
        """How right what is seen looks, as it is, in each of its ways."""
        frames, looks = bodies.frames[:, self.quarters], []
        if self.doors:
            mirror = torch.tensor([1.0, -1.0, 1.0]).to(frames)
            frames = torch.cat([frames, frames * mirror], dim=1)
        for first in range(LOOKS):
            points, surface = (x[0, :, first::LOOKS].to(bodies.frames) for x in bodies[:2])
            images, normal = surface.split([SPIN_CHANNELS, 3], dim=-1)
            seen = SurfaceCloud.of(points, images, normal, self.size).seen_in(frames)
            looks.append(self.surface.seen(seen).view(len(frames), -1, len(self.quarters)).mean(dim=1))
        return torch.stack(looks).mean(dim=0)

    def bodies(
        self,
        prediction: Prediction,
        dense: Tensor,  # [B, P, 3] farthest-point order
        versions: Sequence[Tensor],  # of [B, P, 3] the same points, as they are or with noise
    ) -> Bodies:
        """What is seen of clouds."""
        if not self.doors:
            return self.bodies_at(prediction.base_pose, dense, versions)
        box = self._boxes(prediction.base_pose, dense)
        frame, inside = self._doors(prediction, dense, box[:, :, 0])
        return self._seen(frame, inside, _FEWEST_POINTS, box[:, :, 2], versions)

    def bodies_at(
        self,
        base: Tensor,  # [B, 4, 4] canonical object space -> camera space
        dense: Tensor,  # [B, P, 3] farthest-point order
        versions: Sequence[Tensor],  # of [B, P, 3] the same points, as they are or with noise
    ) -> Bodies:
        """What is seen of bodies that stand so, whatever their doors do."""
        box = self._boxes(base, dense)
        behind = self._behind_the_door(base, dense, box[:, :, 2])
        return self._seen(box, behind, LOOKS * self.size.read, box[:, :, 2], versions)

    def _seen(
        self,
        frame: Tensor,  # [B, 3, 3] hinge first, door's normal last
        own: Tensor,  # [B, P] bool, what is shown
        fewest: int,
        normal: Tensor,  # [B, 3]
        versions: Sequence[Tensor],  # of [B, P, 3]
    ) -> Bodies:
        quarter = torch.tensor([0.0, 0.0, math.pi / 2]).to(frame) * torch.arange(TURNS).to(frame)[:, None]
        frames = frame[:, None] @ roma.rotvec_to_rotmat(quarter)
        known = own.sum(dim=1) >= fewest
        own = own | ~known[:, None]  # of these nothing is decided
        described = [surface_alone(version, own, LOOKS * self.size.read) for version in versions]
        points, surface = (torch.stack(some) for some in zip(*described, strict=True))
        return Bodies(points, surface, frames, normal, known)

    def _boxes(self, base: Tensor, dense: Tensor) -> Tensor:  # [B, 3, 3]
        """Frames of the boxes as they are predicted, each turned to the nearest of the cloud's own axes."""
        axes = manhattan_frames(dense, torch.Generator().manual_seed(0), self.whole)[0].mT
        every = axes[:, None] @ rotation_group(24).elements.to(axes)  # the same axes in every order
        said = base[:, :3, :3] @ self.axes.to(axes)
        nearest = (every * said[:, None]).sum(dim=(-2, -1)).argmax(dim=1)
        return every[torch.arange(len(every), device=every.device), nearest]

    def _doors(
        self,
        prediction: Prediction,
        dense: Tensor,  # [B, P, 3]
        hinge: Tensor,  # [B, 3] direction, square to the box
    ) -> tuple[Tensor, Tensor]:  # [B, 3, 3], [B, P] bool
        """Frames of the doors, those of the boxes when they are closed; and which points are in a slab about them.

        How a door is believed to stand must not show: neither by a lean of its pose, as its plane is found again in the
        cloud, nor by which points are said to be its own, as the slab ends at the hinge and nowhere else.
        """
        child, shut = int(prediction.joint_child[0, 0]), self.shut.to(prediction.joint_state)
        motion = screw_motion(prediction.canonical_axis, prediction.canonical_pivot, shut, REVOLUTE)[:, 0]
        turn, middle = prediction.part_pose[:, child, :3, :3], prediction.part_pose[:, child, None, :3, 3]
        normal = turn @ motion[:, :3, :3].mT @ self.axes[:, 2].to(turn)
        pivot = prediction.joint_pivot[:, :1]
        across = torch.linalg.cross(normal, hinge)
        out = (((middle - pivot) @ across[..., None]).squeeze(-1)).sign()  # the door's side of its hinge
        height = (prediction.part_shape[:, child] @ turn.mT @ normal[..., None]).squeeze(-1)
        reach = (height.amax(1, keepdim=True) - height.amin(1, keepdim=True)) / 2 + _ROOM
        for _ in range(_PLANES):
            inside = ((dense - middle) @ normal[..., None]).squeeze(-1).abs() < reach
            inside &= ((dense - pivot) @ across[..., None]).squeeze(-1) * out > 0
            middle, least = _plane(dense, inside)
            normal = least * (least * normal).sum(-1, keepdim=True).sign()
            hinge = functional.normalize(hinge - (hinge * normal).sum(-1, keepdim=True) * normal, dim=-1)
            across = torch.linalg.cross(normal, hinge)
        return torch.stack([hinge, across, normal], dim=-1), inside

    def _behind_the_door(
        self,
        base: Tensor,  # [B, 4, 4]
        dense: Tensor,  # [B, P, 3]
        normal: Tensor,  # [B, 3] of the doors, pointing at the bodies
    ) -> Tensor:  # [B, P] bool
        """Which points are behind the closed door, where no open one is.

        Which part they are said to be of must not matter: about the hinge, pieces of the body are taken for the door,
        and where they are missed says where the hinge is.
        """
        door = transform_points(base, self.door.to(dense).expand(len(dense), 1, 3))
        return ((dense - door) @ normal[..., None]).squeeze(-1) > _BEHIND


def turned_about(
    prediction: Prediction,
    normal: Tensor,  # [B, 3] unit, camera space
    quarters: Tensor,  # [B]
) -> Prediction:
    """The same parts and joints in camera space, in a frame turned by quarters about the normal through the root."""
    rows = torch.arange(len(normal), device=normal.device)
    middle = prediction.part_pose[rows, prediction.joint_parent[:, 0], :3, 3]
    base = screw_motion(normal, middle, (quarters * (math.pi / 2)).to(normal), REVOLUTE) @ prediction.base_pose
    # From the old canonical space to the new one.
    change = invert_se3(base) @ prediction.base_pose
    turn = change[:, :3, :3]
    pose = prediction.part_pose.clone()
    pose[..., :3, :3] = pose[..., :3, :3] @ turn[:, None].mT
    return replace(
        prediction,
        base_pose=base,
        part_pose=pose,
        part_shape=torch.einsum("bij,bkmj->bkmi", turn, prediction.part_shape),
        assembly=transform_points(change, prediction.assembly),
        canonical_axis=prediction.canonical_axis @ turn.mT,
        canonical_pivot=transform_points(change, prediction.canonical_pivot),
    )


def _plane(
    dense: Tensor,  # [B, P, 3]
    own: Tensor,  # [B, P] bool
) -> tuple[Tensor, Tensor]:  # [B, 1, 3], [B, 3]
    """The mean of points, and the direction in which they extend least."""
    weight = own[..., None].to(dense) / own.sum(dim=1)[:, None, None].clamp_min(1)
    middle = (dense * weight).sum(dim=1, keepdim=True)
    away = dense - middle
    return middle, torch.linalg.eigh((away * weight).mT @ away)[1][..., 0]


def closed_state(shape: ArticulatedShape, state_range: Tensor, frames: PartFrames | None = None) -> float:
    """The joint state at which the door of a category's shape is closed; arguments as of `HingeSides.measure`."""
    return _closed_state(*_boxes(shape, frames), state_range)


def _boxes(
    shape: ArticulatedShape, frames: PartFrames | None
) -> tuple[ArticulatedShape, Tensor, Tensor]:  # , [3, 3], [3, 3]
    """The shape, as far as it counts, and columns: axes of its body and of its door, the hinge first."""
    root, child = shape.joints.chain.root, shape.joints.chain.child[0]
    if frames is not None and frames.flat.all() and frames.measured.all():
        shape = replace(shape, joints=replace(shape.joints, axis=frames.direction))
        return shape, frames.about_joint(root), frames.about_joint(child)
    shape = _without_strays(shape, child)
    return shape, object_axes(shape), _box_axes(shape, child)


def _closed_state(shape: ArticulatedShape, axes: Tensor, own: Tensor, state_range: Tensor) -> float:
    """A closed door is square to its body and near it, and the whole is small.

    By the latter alone a door that holds pieces of the body was taken for closed where it is wide open, by the former
    alone some doors are nearly as close there (docs/experiments.md, step 271).
    """
    root, child = shape.joints.chain.root, shape.joints.chain.child[0]
    hinge, one, other = axes[:, 0], own[:, 1], axes[:, 1]
    square = math.atan2(float(torch.linalg.cross(one, other) @ hinge), float(one @ other))
    states = [square + k * math.pi / 2 for k in range(-8, 9)]
    states = [state for state in states if abs(state - float(state_range.mean())) <= _CLOSED_REACH]

    def open_by(state: float) -> float:
        body, door = shape.part(root), _at(shape, child, state)
        apart = float(torch.cdist(door, body).amin(dim=1).median())
        whole = torch.cat([body, door]).double().cpu().numpy()
        return apart * ConvexHull(whole, qhull_options="QJ").volume  # of flat ones, too

    return min(states, key=open_by)


def _without_strays(shape: ArticulatedShape, part: int) -> ArticulatedShape:
    """The same but for points of a part that lie among those of another: they would make its box another."""
    near = shape.label[torch.cdist(shape.points, shape.points).topk(_NEIGHBOURS, largest=False).indices]
    stray = (shape.label == part) & ((near == part).to(shape.points).mean(dim=1) < _STRAY)
    return replace(shape, label=torch.where(stray, near.mode(dim=1).values, shape.label))


def _box_axes(shape: ArticulatedShape, part: int) -> Tensor:
    """As `object_axes` has them of the root: of the smallest box about a part that has the hinge for an edge."""
    chain = shape.joints.chain
    return object_axes(replace(shape, joints=replace(shape.joints, chain=replace(chain, root=part))))


def _at(shape: ArticulatedShape, part: int, state: float) -> Tensor:
    """A part's points [m, 3] in canonical space, moved by its joint."""
    still = torch.eye(4).to(shape.points)[None]
    pose = shape.joints.part_pose(still, torch.tensor([[state]]).to(shape.points))
    return transform_points(pose[0, part], shape.part(part))
