"""Where sliding parts are, and which way round the object is, by the frames of clouds and without a network.

Chests are boxes: every cloud shows its Manhattan frame, but not which of its 24 rotations is upright, and any single
chest is right about that too rarely. Discovery has settled it for a whole collection (`discovery.synchronization`); so
a new cloud is turned as it is most like some clouds of those chests, or copies of them in other proportions, all
stretched to one box. That decides: a shape that is placed in the cloud, and stretched, fits about as well upside down.
It also teaches a network that sees the surface (`training.turn_lessons`), which then chooses among the likeliest turns.
Where whole objects were discovered, clouds of theirs that are most like the new one, or copies in other proportions and
joint states, say which part its points are of, or a network that they taught, which knows it better (`part_network`),
and the shape's parts fill their boxes; else parts are placed by what every offset costs.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from articulate_ssl.discovery.distance_field import DistanceFields
from articulate_ssl.discovery.instance_fit import InstanceFit
from articulate_ssl.discovery.manhattan_frame import manhattan_frames
from articulate_ssl.discovery.one_object.as_others import find_as_others
from articulate_ssl.discovery.one_object.moving_labels import spread_labels
from articulate_ssl.discovery.one_object.surface import Surface
from articulate_ssl.discovery.part_boxes import fit_part_boxes
from articulate_ssl.discovery.registered_shape import state_limits
from articulate_ssl.discovery.registrar import fit_slides
from articulate_ssl.discovery.similar_clouds import ASKING, LabelledClouds
from articulate_ssl.discovery.synchronization import CAP, NEIGHBOURS, unit_boxes
from articulate_ssl.discovery.varied_clouds import in_other_proportions, varied
from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.geometry.screw import PRISMATIC
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.inference.part_network import PartNetwork
from articulate_ssl.inference.surface_decision import WithSurface
from articulate_ssl.inference.votes import Votes
from articulate_ssl.ops.few_bytes import from_few_bytes, in_few_bytes
from articulate_ssl.shape.articulated_shape import ArticulatedShape
from articulate_ssl.shape.joints import Joints

# Of 540 clouds of unseen chests of three sets, the first turn was right for 90 to 96 % by the clouds most alike of 128,
# for 85 to 92 % by those of 32, and for 80 to 91 % by all 128 (docs/experiments.md, step 98).
_GALLERY, _GALLERY_POINTS = 128, 128  # clouds, and points of each; twice as many points were as right
_LABELLED_POINTS = 512
_PROPORTIONS = 4  # copies of every cloud by which turns are decided: wrong 9 % without, 6 % with 4 or 8
_TURNS = 2  # the likeliest, and its rival
_LEADING = 4  # turns among which a network chooses, if one was taught
_FITTED_POINTS = 1024  # of a cloud, to which the shape is fitted
_PLACED_POINTS = 256  # of the shape, whose offsets are tried
# How far what is said spreads along faces: of 80 clouds, 10 to 100 were alike of votes (step 173); it takes a network's
# mIoU from .914 to .922 (step 179).
_SPREAD = 30.0
_CYCLES = 4  # of the descent on every candidate; twice as many on the best


class Slid(NamedTuple):
    """Where the shape is in B clouds, in each of two turns.

    Attributes:
        shape: Of 2 B candidates, stretched to the clouds' proportions (points [2 B, K M, 3]).
        base: [B, 2, 4, 4]
        state: [B, 2, J]
        margin: [B] how much likelier than the other the likelier turn is.
        votes: Which parts points of the clouds are of in the labelled clouds most alike, if there are any.
    """

    shape: ArticulatedShape
    base: Tensor
    state: Tensor
    margin: Tensor
    votes: Votes | None


class SlidingSearch(WithSurface):
    """Poses and joint states of an articulated shape whose parts slide, in clouds of any orientation.

    It computes on the CPU, wherever its buffers are, because distance fields do.

    Args:
        whole: Whether clouds show all sides.

    Attributes:
        gallery: [R, P, 3] training clouds in canonical orientation, stretched to boxes of width one; none before
            anything was learnt.
        labelled: [r, P, 3] int8, clouds of whole objects in the same boxes, in steps of the lengths `step` [r].
        part: [r, P] uint8, which part their points are of.
        points: [K, M, 3] the shape in canonical object space, whose axes are the clouds' common frame.
        axis, pivot: [J, 3] its joints; limits: [J, 2] of their states.
        surface: Which of the leading turns looks right, if that was taught.
        parts: Which part points are of, if that was taught; else labelled clouds say it.
    """

    def __init__(self, num_parts: int, shape_points: int, whole: bool = True) -> None:
        super().__init__()
        joints, self.whole = num_parts - 1, whole
        self.register_module("parts", None)
        self._copies: tuple[Tensor | None, LabelledClouds | None] = None, None  # of the clouds `labelled`
        self.register_buffer("gallery", torch.zeros(0, _GALLERY_POINTS, 3))
        self.register_buffer("labelled", torch.zeros(0, _LABELLED_POINTS, 3, dtype=torch.int8))
        self.register_buffer("step", torch.zeros(0))
        self.register_buffer("part", torch.zeros(0, _LABELLED_POINTS, dtype=torch.uint8))
        self.register_buffer("points", torch.zeros(num_parts, shape_points, 3))
        self.register_buffer("axis", torch.zeros(joints, 3))
        self.register_buffer("pivot", torch.zeros(joints, 3))
        self.register_buffer("limits", torch.zeros(joints, 2))

    @property
    def learnt(self) -> bool:
        """Whether there is anything to search for."""
        return len(self.gallery) > 0

    def forget(self) -> None:
        """As before anything was learnt."""
        self.gallery = self.gallery[:0]

    def learn(
        self,
        shape: ArticulatedShape,  # M points of every part in turn, in a frame common to the clouds
        limits: Tensor,  # [J, 2]
        clouds: Tensor,  # [n, N, 3] training clouds
        base: Tensor,  # [n, 4, 4] canonical object space -> cloud
        labelled: LabelledClouds | None = None,
    ) -> None:
        """Keep a shape, some of the clouds it was found in, spread evenly, and all whose points have parts."""
        self.learn_standing(clouds, base[:, :3, :3])
        if labelled is not None:
            self.learn_labelled(labelled)
        self.points.copy_(shape.points.view_as(self.points))
        self.axis.copy_(shape.joints.axis)
        self.pivot.copy_(shape.joints.pivot)
        self.limits.copy_(limits)

    def learn_standing(
        self,
        clouds: Tensor,  # [n, N, 3] training clouds
        rotation: Tensor,  # [n, 3, 3] canonical orientation -> cloud
    ) -> None:
        """Keep some of the clouds, spread evenly, in place of others that turns are told by."""
        some = torch.linspace(0, len(clouds) - 1, min(len(clouds), _GALLERY)).round().long()
        boxes, _, _ = unit_boxes(clouds[some] @ rotation[some])
        self.gallery = boxes[:, :_GALLERY_POINTS].to(self.gallery, copy=True)

    def learn_labelled(self, labelled: LabelledClouds) -> None:
        """Keep clouds whose points have parts, in place of others."""
        rounded, step = in_few_bytes(labelled.points[:, :_LABELLED_POINTS])
        self.labelled, self.step = rounded.to(self.labelled), step.to(self.step)
        self.part = labelled.part[:, :_LABELLED_POINTS].to(self.part)

    @torch.no_grad()
    def learn_limits(
        self,
        chain: KinematicChain,
        standing: Tensor,  # [n, P, 3] clouds that stand as the collection does
        part: Tensor,  # [n, M] of their leading points
    ) -> Tensor:  # [J, 2]
        """Between which joint states lie, as they are read off clouds whose points have parts."""
        shape, seen = self._shape(chain), standing[:, : part.shape[1]].to("cpu", copy=True)
        free = replace(shape, joints=replace(shape.joints, limits=None))
        self.limits.copy_(state_limits(fit_part_boxes(free, seen, part.long().cpu()).state))
        return self.limits

    @torch.no_grad()
    def turns(
        self,
        clouds: Tensor,  # [B, N, 3] with all their points, on the CPU
    ) -> tuple[Tensor, Tensor]:  # [B, 2, 3, 3], [B]
        """Rotations cloud -> canonical orientation, the likeliest two, and how much likelier the first is."""
        turn, cost = self.leading_turns(clouds)
        if self.surface is None:
            return turn[:, :_TURNS], (1 - cost[:, 0] / cost[:, 1]).clamp(0, 1)
        turn, odds = self._looked_at(turn, clouds)
        margin = ((odds[:, 0] - odds[:, 1]) / (2 * self.surface.temperature.cpu())).tanh()
        return turn[:, :_TURNS], margin

    def _looked_at(
        self,
        turn: Tensor,  # [B, C, 3, 3]
        clouds: Tensor,  # [B, N, 3]
    ) -> tuple[Tensor, Tensor]:  # [B, C, 3, 3], [B, C]
        """The turns in the order in which a network takes them for right, and how right they look."""
        where = self.surface.temperature.device
        odds = self.surface.looks_right(turn.mT.to(where), clouds.to(where)).cpu()
        odds, index = odds.sort(dim=1, descending=True)
        return turn[torch.arange(len(turn))[:, None], index], odds

    @torch.no_grad()
    def leading_turns(
        self,
        clouds: Tensor,  # [B, N, 3] with all their points, on the CPU
    ) -> tuple[Tensor, Tensor]:  # [B, C, 3, 3], [B, C]
        """Rotations cloud -> canonical orientation, the likeliest first, and how far the clouds most alike then are."""
        rotation, _ = manhattan_frames(clouds, torch.Generator().manual_seed(0), self.whole)
        boxes, _, _ = unit_boxes(clouds @ rotation.mT)
        group = rotation_group(24).elements.to(clouds)
        gallery = in_other_proportions(self.gallery.cpu(), _PROPORTIONS, torch.Generator().manual_seed(0))
        # What is g @ box in canonical orientation lies in the box where the inverse of g puts it.
        turned = torch.einsum("gji,rpj->grpi", group, gallery)
        found, costs = [], []
        for box, frame in zip(boxes, rotation, strict=True):
            cost = DistanceFields.of(box[None]).at(0, turned).clamp(max=CAP).mean(dim=2)  # [G, R]
            alike = cost.topk(min(NEIGHBOURS, len(gallery)), dim=1, largest=False).values
            least = alike.mean(dim=1).topk(_LEADING, largest=False)
            found.append(group[least.indices] @ frame)
            costs.append(least.values)
        return torch.stack(found), torch.stack(costs)

    @torch.no_grad()
    @torch.inference_mode(mode=False)  # the fit descends
    def search(
        self,
        chain: KinematicChain,
        clouds: Tensor,  # [B, N, 3] with all their points
    ) -> Slid:
        """The shape in every cloud, in each of two turns, the likelier first (`turns`)."""
        device, clouds = clouds.device, clouds.cpu().clone()  # no inference tensor
        turn, margin = self.turns(clouds)
        copies = torch.einsum("bcij,bnj->bcni", turn, clouds).flatten(0, 1)
        said = None if self.parts is None else self._said(clouds, turn).flatten(0, 1)
        fit, share = self._fitted(self._shape(chain), copies, said)
        back = se3(turn.mT, turn.new_zeros(*turn.shape[:2], 3))
        base, state = (value.unflatten(0, turn.shape[:2]).to(device) for value in (fit.base, fit.state))
        found = fit.instances()
        joints = found.joints
        lines = {name: getattr(joints, name).to(device) for name in ("axis", "pivot", "limits")}
        found = ArticulatedShape(found.points.to(device), found.label.to(device), replace(joints, **lines))
        votes = None if share is None else Votes(clouds.to(device), share.to(device))
        return Slid(found, back.to(device) @ base, state, margin.to(device), votes)

    def _said(self, clouds: Tensor, turn: Tensor) -> Tensor:  # [B, 2, N, K]
        """By the network, which part points are of in each of two turns."""
        where = self.points.device
        return self.parts.probability(clouds.to(where), turn.to(where)).cpu()

    def _fitted(
        self,
        shape: ArticulatedShape,
        clouds: Tensor,  # [2 B, N, 3] turned
        said: Tensor | None,  # [2 B, N, K] which parts points are of
    ) -> tuple[InstanceFit, Tensor | None]:  # , [B, N, K]
        """The shape in the clouds, and which parts points are of in the likelier turn, if others say it."""
        if not len(self.labelled):
            axes = torch.eye(3).to(clouds).expand(len(self.points), 3, 3)
            generator, few = torch.Generator().manual_seed(0), clouds[:, :_FITTED_POINTS].contiguous()
            return fit_slides(shape, axes, few, _PLACED_POINTS, _CYCLES, generator), None
        if said is None:
            boxes = unit_boxes(clouds)[0]
            said = self._varied(shape.joints).votes(boxes[:, :ASKING], shape.num_parts, boxes)
        said = torch.stack([_along_faces(*some) for some in zip(clouds, said, strict=True)])
        return fit_part_boxes(shape, clouds, said.argmax(dim=-1)), said[::_TURNS]

    @torch.no_grad()
    def understood(
        self,
        chain: KinematicChain,
        clouds: Tensor,  # [n, N, 3] of one object
    ) -> tuple[LabelledClouds, Tensor]:  # , [n, 3, 3]
        """What may be kept of the object beside clouds whose points have parts, by these and by how it moves.

        And cloud -> the frame in which it stands as the collection does.

        Raises:
            DiscoveryError: if that does not explain it.
        """
        clouds = clouds.cpu()
        turn, _ = self.leading_turns(clouds)
        if self.surface is not None:
            turn, _ = self._looked_at(turn, clouds)
        joints = self.joints(chain)
        found, turn = find_as_others(clouds, turn, self._varied(joints), joints)
        return LabelledClouds(unit_boxes(clouds @ turn.mT)[0][:, : found.label.shape[1]], found.label), turn

    def joints(self, chain: KinematicChain) -> Joints:
        """Of the shape, on the CPU."""
        return self._shape(chain).joints

    def _varied(self, joints: Joints) -> LabelledClouds:
        """The labelled clouds and copies of them, made when they are first asked for."""
        of, found = self._copies
        if of is not self.labelled:
            labelled = LabelledClouds(from_few_bytes(self.labelled.cpu(), self.step.cpu()), self.part.cpu())
            found = varied(labelled, joints, torch.Generator().manual_seed(0))
            self._copies = self.labelled, found
        return found

    def _shape(self, chain: KinematicChain) -> ArticulatedShape:
        points, axis, pivot, limits = (value.cpu() for value in (self.points, self.axis, self.pivot, self.limits))
        label = torch.arange(len(points)).repeat_interleave(points.shape[1])
        return ArticulatedShape(points.flatten(0, 1), label, Joints(chain, axis, pivot, PRISMATIC, limits))

    def _load_from_state_dict(self, state_dict: dict, prefix: str, *rest) -> None:
        """Galleries have any size; weights from before there was a search have none."""
        for name, own in list(self.named_buffers(recurse=False)):
            value = state_dict.setdefault(prefix + name, own.clone())
            setattr(self, name, torch.empty_like(value, dtype=own.dtype, device=own.device))
        taught = any(name.startswith(f"{prefix}parts.") for name in state_dict)
        self.parts = PartNetwork(len(self.points)).to(self.points).requires_grad_(False) if taught else None
        super()._load_from_state_dict(state_dict, prefix, *rest)


def _along_faces(
    cloud: Tensor,  # [N, 3]
    votes: Tensor,  # [M, K] of its leading points
) -> Tensor:  # [M, K]
    """What the faces say that points are on."""
    surface = Surface.of(cloud.double().numpy()).thinned(len(votes))
    return torch.from_numpy(spread_labels(surface, votes.double().numpy(), _SPREAD)).to(votes)
