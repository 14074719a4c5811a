"""NPCS with labels: part and rest-state coordinates of every point, poses by RANSAC, joints in canonical space.

Li et al. 2020 (ANCSH / NPCS) as the paper runs it (appendix "Implementation details for baselines"): the network also
selects a discrete rotation mode, with supervision. Two rows of the table are this file with modes and without.

What the paper leaves open is decided here. Modes are turned copies of the cloud (`surface_network.py`), of which
training needs a few only: right ones and wrong ones, half of these from where the cloud looks most like itself. The
network reads spin images and normals that are found in the dense cloud, without which base and lid of a laptop are the
same. It looks at the leading modes again, in the frames that their residual rotations lead to. Joint lines are said in
the parent's canonical space, as in ANCSH, and not in that of the mode.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import roma
import torch
from torch import Tensor, nn
from torch.nn import functional

from articulate_ssl.baselines.method import DENSE_CLOUDS, JOINTS, PART_LABELS, PART_POSES, Effort, Method, Problem
from articulate_ssl.baselines.part_coordinates import ransac_poses
from articulate_ssl.geometry.orientation_range import OrientationRange, mean_rotation
from articulate_ssl.geometry.rotation_group import rotation_group
from articulate_ssl.geometry.se3 import invert_se3, se3, transform_points
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.network.coordinate_network import CoordinateNetwork, WholeShape
from articulate_ssl.network.surface_network import MODES, SurfaceCloud, SurfaceSize
from articulate_ssl.ops.spin_images import SPIN_CHANNELS, spin_images
from articulate_ssl.shape.part_poses import joint_states, nearest_on_line, part_shapes
from datamodules.articulated_data_module import ArticulatedDataModule

_NEAR_DEG = 10.0  # standard deviation per axis of a frame that was looked at before
_WRONG_DEG = 60.0  # frames farther from the right one are wrong: no mode has a rotation farther than 45 to itself
_LIKE_FRAMES = 4  # wrong frames that are drawn from: those in which the cloud looks most like itself
_LIKE_POINTS = 64  # that this is judged by
_DRAWS = 8  # of rotations to find a wrong one among; all are right in one of 10^10 clouds
_LEADING = 4  # modes that are looked at again
_DISTINCT_DEG = 45.0  # leading modes say rotations at least this far apart
_CHUNK_COPIES = 512  # turned copies of clouds that a test holds at a time
_STRUCTURE_CLOUDS = 64  # that rest states and the mean orientation are measured on
_GRADIENT_NORM = 1.0
# Of the loss. Lengths are about .05 where angles are about 1 at the start; chosen without a measurement.
_LENGTH_WEIGHT = 10.0


@dataclass(frozen=True)
class Target:
    """Labels as the network says them. B clouds.

    Attributes:
        part_id: [B, N].
        pose: [B, K, 4, 4] part space -> camera space; its origin is the part's centre.
        center: [B, K, 3] in the object's rest-state frame.
        axis: [B, J, 3] in the axes of part spaces.
        pivot: [B, J, 3] the point of the joint line at rest that is nearest to the parent's centre, relative to it.
    """

    part_id: Tensor
    pose: Tensor
    center: Tensor
    axis: Tensor
    pivot: Tensor

    @staticmethod
    def of(labels: dict[str, Tensor]) -> Target:
        """From shard arrays; input points lead the dense ones."""
        center = labels["part_center"]
        identity = torch.eye(3, dtype=center.dtype, device=center.device)
        pose = labels["part_pose"] @ se3(identity, center)
        to_parent = invert_se3(pose[torch.arange(len(pose))[:, None], labels["joint_parent"].long()])
        axis = (to_parent[..., :3, :3] @ labels["joint_axis"][..., None]).squeeze(-1)
        pivot = transform_points(to_parent, labels["joint_pivot"][..., None, :]).squeeze(-2)
        count = labels["points"].shape[1]
        return Target(labels["dense_part_id"][:, :count].long(), pose, center, axis, nearest_on_line(pivot, axis))

    def leading(self, count: int) -> Target:
        """The same of the first points only."""
        return replace(self, part_id=self.part_id[:, :count])

    def coordinates(self, points: Tensor) -> Tensor:  # [B, N, 3]
        """Of points [B, N, 3], each in the space of its own part."""
        every = transform_points(invert_se3(self.pose), points[:, None])  # [B, K, N, 3]
        return every.gather(1, self.part_id[:, None, :, None].expand(-1, -1, -1, 3)).squeeze(1)


class ModeNetwork(CoordinateNetwork):
    """And a head for the mode."""

    def __init__(self, num_parts: int, size: SurfaceSize) -> None:
        """Args: K; sizes."""
        super().__init__(num_parts, size)
        self.mode = nn.Linear(size.head_dim, 1)

    def mode_of(self, said: WholeShape) -> Tensor:  # [B]
        """Logit that the frame is near the canonical one."""
        return self.mode(said.whole).squeeze(-1)


class NPCS(Method):
    """What both rows share.

    Attributes:
        modes: Whether the frame is chosen among the group's, or taken as it comes.
    """

    given = (PART_LABELS, PART_POSES, JOINTS, DENSE_CLOUDS)
    labelled_spaces = True
    modes: ClassVar[bool]

    def __init__(self, problem: Problem, size: SurfaceSize | None = None) -> None:
        """Args: the category; sizes other than the usual ones."""
        super().__init__(problem)
        self.size = size or SurfaceSize()
        joints = problem.num_parts - 1
        self.network = ModeNetwork(problem.num_parts, self.size)
        self.register_buffer("elements", rotation_group(MODES).elements.float(), persistent=False)
        self.register_buffer("cube", rotation_group(24).elements.float(), persistent=False)
        self.register_buffer("joint_parent", torch.zeros(joints, dtype=torch.long))
        self.register_buffer("joint_child", torch.arange(1, joints + 1))
        self.register_buffer("rest_state", torch.zeros(joints))
        self.register_buffer("mean_rotation", torch.eye(3))
        self.orientation = OrientationRange(problem.orientation_range)
        self._surface: dict[int, Tensor] = {}  # of training clouds, by sample: turning a cloud does not change it

    @property
    def root(self) -> int:
        """The part that is no joint's child."""
        return next(k for k in range(self.problem.num_parts) if k not in self.joint_child.tolist())

    def prepare(self, data: ArticulatedDataModule, seed: int) -> None:
        """The tree, which state of every joint is rest, and the mean orientation, from labels of training clouds."""
        batches = list(data.calibration_dataloader(_STRUCTURE_CLOUDS))
        self.read_structure({name: torch.cat([batch[name] for batch in batches]) for name in batches[0]})

    def read_structure(self, labels: dict[str, Tensor]) -> None:
        """The tree and the states at rest, the same in all clouds of a category, and the mean orientation."""
        self.joint_parent.copy_(labels["joint_parent"][0])
        self.joint_child.copy_(labels["joint_child"][0])
        target = Target.of(labels)
        moved = self.states(target.pose, target.center, target.axis)
        self.rest_state.copy_((labels["joint_state"] - moved).median(0).values)
        self.mean_rotation.copy_(mean_rotation(target.pose[:, self.root, :3, :3]))

    def states(self, pose: Tensor, center: Tensor, axis: Tensor) -> Tensor:
        """[B, J] relative to rest; see `joint_states`."""
        return joint_states(pose, center, axis, self.joint_parent, self.joint_child, self.problem.joint_type)

    def training_step(self, batch: dict[str, Tensor], batch_idx: int) -> Tensor:
        """The loss of one step; the batch has its dense points and their parts."""
        if "dense_part_id" not in batch:
            raise ValueError("NPCS learns from part labels: open the data with dense_in_fit=True")
        target = Target.of(batch).leading(self.size.read)
        points = batch["points"][:, : self.size.read]
        geometry = SurfaceCloud.of(points, *self.known_surface(batch), self.size)
        if not self.modes:
            frame = torch.eye(3, device=self.device).expand(len(target.pose), 1, 3, 3)
            return self.point_loss(geometry.seen_in(frame), frame, target, points)[0]
        right = self.right_frames(target)
        wrong = self.wrong_frames(geometry, target)
        loss, positive = self.point_loss(geometry.seen_in(right), right, target, points)
        negative = self.network.mode_of(self.network.look(geometry.seen_in(wrong))).unflatten(0, (-1, wrong.shape[1]))
        positive = positive.unflatten(0, (-1, right.shape[1]))
        # Every right frame against all wrong ones of its cloud.
        logits = torch.cat([positive[..., None], negative[:, None].expand(-1, right.shape[1], -1)], dim=-1)
        mode = -logits.log_softmax(-1)[..., 0].mean()
        self.log("mode", mode)
        return loss + mode

    def known_surface(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Spin images and normals of training clouds, computed once for each: they would be half of a step.

        Normals are kept in the object's frame. Where the data add noise, its first draw is the one that is seen.
        """
        samples, turn = batch["sample"].tolist(), batch["object_rotation"]
        new = [i for i, sample in enumerate(samples) if sample not in self._surface]
        if new:
            images, normal = spin_images(batch["points"][new, : self.size.read], batch["dense_points"][new])
            both = torch.cat([images, normal @ turn[new]], dim=-1).half()
            self._surface.update(zip((samples[i] for i in new), both, strict=True))
        known = torch.stack([self._surface[sample] for sample in samples]).to(batch["points"])
        images, normal = known.split([SPIN_CHANNELS, 3], dim=-1)
        return images, normal @ turn.transpose(-1, -2)

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Clip the gradient: a wrong mode that leads by much would undo many steps."""
        torch.nn.utils.clip_grad_norm_(self.parameters(), _GRADIENT_NORM)

    def on_train_end(self) -> None:
        """Forget what only training needs."""
        self._surface.clear()

    def right_frames(self, target: Target) -> Tensor:  # [B, 2, 3, 3]
        """A mode that is near the root's pose, and a frame that a second look would have."""
        root = target.pose[:, self.root, :3, :3]
        any_rotation = roma.random_rotmat(len(root), device=root.device)
        nearest = rotation_group(MODES).nearest(any_rotation)
        residual = self.elements[nearest].transpose(-1, -2) @ any_rotation
        near = roma.rotvec_to_rotmat(torch.randn(2, len(root), 3, device=root.device) * _radians(_NEAR_DEG))
        return torch.stack([root @ residual @ near[0], root @ near[1]], dim=1)

    def wrong_frames(self, geometry: SurfaceCloud, target: Target) -> Tensor:  # [B, 2, 3, 3]
        """Frames to be told from the right ones: one in which the cloud looks like itself, and any.

        Candidates for the former are turns of a cube from every part's pose, which is where boxes and plates that were
        taken for each other lead.
        """
        rotation = target.pose[..., :3, :3]
        root = rotation[:, self.root]
        turned = (rotation[:, :, None] @ self.cube).flatten(1, 2)  # [B, 24 K, 3, 3]
        points = geometry.points[:, :_LIKE_POINTS]
        copies = torch.einsum("bni,bcij->bcnj", points, turned)
        distance = torch.cdist(copies, (points @ root)[:, None].expand_as(copies))
        unlike = distance.amin(-1).mean(-1) + distance.amin(-2).mean(-1)
        unlike = unlike.masked_fill(_angle(turned, root[:, None]) < _radians(_WRONG_DEG), torch.inf)
        like = unlike.topk(min(_LIKE_FRAMES, unlike.shape[1]), largest=False).indices
        rows = torch.arange(len(root), device=root.device)
        alike = turned[rows, like[rows, torch.randint(like.shape[1], (len(root),), device=root.device)]]
        alike = alike @ roma.rotvec_to_rotmat(torch.randn(len(root), 3, device=root.device) * _radians(_NEAR_DEG))
        draws = roma.random_rotmat(_DRAWS * len(root), device=root.device).unflatten(0, (len(root), _DRAWS))
        far = (_angle(draws, root[:, None]) > _radians(_WRONG_DEG)).float().argmax(1)
        return torch.stack([alike, draws[rows, far]], dim=1)

    def point_loss(
        self, seen: SurfaceCloud, frame: Tensor, target: Target, points: Tensor
    ) -> tuple[Tensor, Tensor]:  # [], [B S]
        """Everything but the mode, in right frames [B, S, 3, 3]; and the logits of these."""
        copies = frame.shape[1]
        said = self.network.look(seen)
        logits, coordinates = self.network.coordinates(seen, said)
        part_id, own, pose, center, axis, pivot = (
            x.repeat_interleave(copies, dim=0)
            for x in (
                target.part_id,
                target.coordinates(points),
                target.pose,
                target.center,
                target.axis,
                target.pivot,
            )
        )
        rotation = frame.flatten(0, 1)[:, None].transpose(-1, -2) @ pose[..., :3, :3]
        mine = coordinates.gather(1, part_id[:, None, :, None].expand(-1, -1, -1, 3)).squeeze(1)
        losses = {
            "segmentation": functional.cross_entropy(logits.flatten(0, 1), part_id.flatten()),
            "coordinates": _LENGTH_WEIGHT * (mine - own).norm(dim=-1).mean(),
            "rotation": (said.rotation - rotation).square().sum((-1, -2)).mean(),
            "axis": (said.axis - axis).norm(dim=-1).mean(),
            "lengths": (said.center - center).norm(dim=-1).mean() + (said.pivot - pivot).norm(dim=-1).mean(),
        }
        for name, value in losses.items():
            self.log(name, value)
        return sum(losses.values()), self.network.mode_of(said)

    @torch.no_grad()
    def predict(self, batch: dict[str, Tensor]) -> Prediction:
        """Reads `points` and `dense_points`, which these lead; labels all."""
        points, dense = batch["points"], batch["dense_points"]
        surface = spin_images(points[:, : self.size.read], dense)
        frame, margin = self.choose_frames(SurfaceCloud.of(points, *surface, self.size))
        seen = SurfaceCloud.of(dense, *surface, self.size).seen_in(frame[:, None])
        said = self.network.look(seen)
        logits, coordinates = self.network.coordinates(seen, said)
        own = slice(points.shape[1])
        found = self.assemble(points, logits[:, own], coordinates[:, :, own], said, margin)
        return replace(found, dense_part_id=logits.argmax(-1))

    def choose_frames(self, geometry: SurfaceCloud) -> tuple[Tensor, Tensor]:  # [B, 3, 3], [B]
        """The frame in which every cloud is read, and how much better it is than the next that is turned another way.

        With modes: the leading ones that are distinct are looked at again in the frame that their residual rotation
        leads to. Without: as the cloud comes, margin 1.
        """
        B = len(geometry.points)
        if not self.modes:
            identity = torch.eye(3, dtype=geometry.points.dtype, device=geometry.points.device)
            return identity.expand(B, 3, 3), geometry.points.new_ones(B)
        logit, rotation = self._look_from(geometry, self.elements.expand(B, -1, -1, -1))
        leading = distinct(logit, rotation, _LEADING, _radians(_DISTINCT_DEG))
        frames = rotation[torch.arange(B, device=leading.device)[:, None], leading]
        logit, rotation = self._look_from(geometry, frames)
        # A mode that led to another's rotation is no rival of it.
        best = logit.argmax(1)
        rows = torch.arange(B, device=best.device)
        same = _angle(rotation, rotation[rows, best][:, None]) < _radians(_DISTINCT_DEG)
        rival = logit.masked_fill(same, -torch.inf).amax(1)
        margin = (2 * torch.sigmoid(logit[rows, best] - rival) - 1).clamp(0, 1)
        return rotation[rows, best], margin

    def _look_from(self, geometry: SurfaceCloud, frame: Tensor) -> tuple[Tensor, Tensor]:  # [B, S], [B, S, 3, 3]
        """Mode logits in frames [B, S, 3, 3], and the root's rotation as seen from each; too far turned is never."""
        logits, rotations = [], []
        for rows in _chunks(len(frame), max(1, _CHUNK_COPIES // frame.shape[1])):
            said = self.network.look(geometry.rows(rows).seen_in(frame[rows]))
            logits.append(self.network.mode_of(said).unflatten(0, (-1, frame.shape[1])))
            rotations.append(frame[rows] @ said.rotation[:, self.root].unflatten(0, (-1, frame.shape[1])))
        logit, rotation = torch.cat(logits), torch.cat(rotations)
        inside = self.orientation.contains(self.mean_rotation.T @ rotation)
        # Where all are turned too far, none is excluded.
        return logit.masked_fill(~inside & inside.any(1, keepdim=True), -torch.inf), rotation

    def assemble(
        self,
        points: Tensor,  # [B, N, 3]
        logits: Tensor,  # [B, N, K]
        coordinates: Tensor,  # [B, K, N, 3]
        said: WholeShape,
        margin: Tensor,  # [B]
    ) -> Prediction:
        """Poses by RANSAC from the points of every part, and joints placed by the parent's pose."""
        K, count = self.problem.num_parts, points.shape[1]
        probability = logits.softmax(-1)
        part_id = probability.argmax(-1)
        own = functional.one_hot(part_id, K).to(points.dtype)
        pose = ransac_poses(coordinates, points, own.transpose(1, 2))
        joints = self.joint_parent.tolist(), self.joint_child.tolist(), self.problem.joint_type
        placed = said.placed(pose, *joints)
        placed["joint_state"] = self.rest_state + placed["joint_state"]
        posed = transform_points(pose, coordinates).gather(1, part_id[:, None, :, None].expand(-1, -1, -1, 3))
        B = len(points)
        return Prediction(
            part_id=part_id,
            part_probability=probability,
            part_shape=part_shapes(coordinates, part_id, count),
            joint_parent=self.joint_parent.expand(B, -1),
            joint_child=self.joint_child.expand(B, -1),
            joint_type=torch.full_like(self.joint_parent, self.problem.joint_type).expand(B, -1),
            reconstruction_error=(posed.squeeze(1) - points).norm(dim=-1).mean(-1),
            margin=margin,
            **placed,
        )


class NPCSEPN(NPCS):
    """Equivariant under the icosahedral group: turning a cloud by a group element permutes its modes."""

    title = "NPCS-EPN"
    effort = Effort(steps=5500, batch_size=16, learning_rate=2e-3)
    modes = True


class NPCSKPConv(NPCS):
    """The same network, which sees every cloud as it comes, once (paper, appendix "Comparison with …")."""

    title = "NPCS-KPConv"
    # NPCS-EPN looks at four copies of each of 16 clouds: about as much work.
    effort = Effort(steps=5500, batch_size=40, learning_rate=2e-3)
    modes = False


def distinct(
    logit: Tensor,  # [B, S]
    rotation: Tensor,  # [B, S, 3, 3]
    count: int,
    angle: float,
) -> Tensor:  # [B, count]
    """Indices of the best, each at least `angle` from those before it while there are such; else the best again."""
    open_, chosen = torch.ones_like(logit, dtype=torch.bool), []
    rows = torch.arange(len(logit), device=logit.device)
    for _ in range(count):
        best = torch.where(open_.any(1), logit.masked_fill(~open_, -torch.inf).argmax(1), logit.argmax(1))
        chosen.append(best)
        open_ = open_ & (_angle(rotation, rotation[rows, best][:, None]) > angle)
    return torch.stack(chosen, dim=1)


def _angle(a: Tensor, b: Tensor) -> Tensor:
    """Angle between rotations [..., 3, 3]."""
    return ((torch.einsum("...ij,...ij->...", *torch.broadcast_tensors(a, b)) - 1) / 2).clamp(-1, 1).acos()


def _radians(degrees: float) -> float:
    return degrees * torch.pi / 180


def _chunks(count: int, size: int) -> Iterator[slice]:
    return (slice(i, i + size) for i in range(0, count, size))
