"""A network that says where the parts of a cloud are nearly as precisely as the fits that taught it.

The articulated network's hypotheses are some degrees off: they are turned in so many ways, and stretch one shape.
Seen in the frame of the one that was decided for, a cloud stands nearly as all others do; there it is asked which part
every point is of, and where in the part (`network.coordinate_network`). Poses follow from both at once, by Procrustes,
and part shapes are the points themselves. It is taught by registered predictions of training clouds
(`training/pose_lessons.py`), no label is read; which part points are of it says more rightly than they do. With spin
images it was no better (docs/experiments.md, step 210).
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn
from torch.nn.functional import one_hot

from articulate_ssl.geometry.se3 import transform_points
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.network.coordinate_network import CoordinateNetwork, WholeShape
from articulate_ssl.network.surface_network import SurfaceCloud, SurfaceSize
from articulate_ssl.shape.part_poses import part_shapes, rigid_fit

SIZE = SurfaceSize(read=512, centers=256)
_LOOKS = 2  # the second in the frame that the first led to
_CHUNK = 4  # clouds of whose points it is asked at a time: what a CPU works on stays in cache
_WEIGHINGS = 2  # after the first fit, points that it leaves far off count less


class PoseNetwork(nn.Module):
    """Predictions with poses, and parts of points, as the network says them, if it was taught.

    Args:
        num_parts: K.

    Attributes:
        network: See above; None if it was not taught.
    """

    network: CoordinateNetwork | None

    def __init__(self, num_parts: int) -> None:
        super().__init__()
        self.num_parts = num_parts
        self.register_module("network", None)
        self.register_buffer("like", torch.zeros(()), persistent=False)  # where, and of which type, weights are loaded

    @property
    def learnt(self) -> bool:
        """Whether it was taught."""
        return self.network is not None

    @torch.no_grad()
    def posed(
        self,
        found: Prediction,  # of B clouds
        points: Tensor,  # [B, N, 3]
        dense: Tensor,  # [B, P, 3] that the points lead, farthest-point order
    ) -> Prediction:
        """Predictions as the network sees the clouds in the frames of those that were found.

        Poses, shapes, joint lines and states, and parts of points are the network's; errors and margins stay.
        """
        frame, few = found.base_pose[:, :3, :3], SurfaceCloud.of_points(points[:, : SIZE.read], SIZE)
        root = next(part for part in range(found.num_parts) if part not in found.joint_child[0].tolist())
        for _ in range(_LOOKS - 1):
            frame = frame @ self.network.look(few.seen_in(frame[:, None])).rotation[:, root]
        said, logits, coordinates = self._asked(dense, frame)
        found = _labelled(found, logits, points.shape[1])
        pose = part_poses(coordinates[:, :, : points.shape[1]], points, found.part_id)
        joints = found.joint_parent[0].tolist(), found.joint_child[0].tolist(), int(found.joint_type[0, 0])
        shape = part_shapes(coordinates, found.dense_part_id, found.part_shape.shape[2])
        return replace(found, part_shape=shape, **said.placed(pose, *joints))

    @torch.no_grad()
    def labelled(
        self,
        found: Prediction,  # of B clouds
        points: Tensor,  # [B, N, 3]
        dense: Tensor,  # [B, P, 3] that the points lead, farthest-point order
    ) -> Prediction:
        """The same predictions, in which points are of the parts that the network says."""
        _, logits, _ = self._asked(dense, found.base_pose[:, :3, :3])
        return _labelled(found, logits, points.shape[1])

    def _asked(self, dense: Tensor, frame: Tensor) -> tuple[WholeShape, Tensor, Tensor]:
        """What is said of the whole clouds, and logits [B, P, K] and coordinates [B, K, P, 3] of their points."""
        seen = SurfaceCloud.of_points(dense, SIZE).seen_in(frame[:, None])
        said = self.network.look(seen)
        some = torch.arange(len(dense), device=dense.device).split(_CHUNK)
        logits, coordinates = zip(*(self.network.coordinates(seen.rows(r), said.rows(r)) for r in some), strict=True)
        return said, torch.cat(logits), torch.cat(coordinates)

    def _load_from_state_dict(self, state_dict: dict, prefix: str, *rest) -> None:
        self.network = None
        if any(name.startswith(f"{prefix}network.") for name in state_dict):
            self.network = CoordinateNetwork(self.num_parts, SIZE).to(self.like).requires_grad_(False)
        super()._load_from_state_dict(state_dict, prefix, *rest)


def part_poses(
    coordinates: Tensor,  # [B, K, N, 3] of every point in every part's space
    points: Tensor,  # [B, N, 3]
    part_id: Tensor,  # [B, N]
) -> Tensor:  # [B, K, 4, 4] part space -> camera space
    """Of every part the pose that moves its points' coordinates to them; those that stay far off count less.

    A part without points is fitted to all.
    """
    parts = coordinates.shape[1]
    target = points[:, None].expand(-1, parts, -1, -1)
    own = one_hot(part_id, parts).mT.to(points)
    own = torch.where(own.any(dim=-1, keepdim=True), own, 1.0)
    pose = rigid_fit(coordinates, target, own)
    for _ in range(_WEIGHINGS):
        distance = (transform_points(pose, coordinates) - target).norm(dim=-1)
        usual = (distance * own).sum(-1, keepdim=True) / own.sum(-1, keepdim=True)
        pose = rigid_fit(coordinates, target, own / (1 + (distance / usual.clamp(min=1e-6)).square()))
    return pose


def _labelled(found: Prediction, logits: Tensor, count: int) -> Prediction:
    """With parts of points, of which so many lead the dense ones, by logits [B, P, K] of the latter."""
    probability, part = logits[:, :count].softmax(-1), logits.argmax(-1)
    return replace(found, part_id=part[:, :count], part_probability=probability, dense_part_id=part)
