"""Which part is the base, where cameras are held upright: the one that stands.

A tree of parts that move about each other has no root of its own: a laptop is a base with a lid as well as a lid with a
base, and discovery takes either. What stands on the ground shows a camera held upright one of its directions, that of
gravity, the same way in every cloud; what moves on it does not. No label is read.
"""

from __future__ import annotations

from dataclasses import replace

import networkx as nx
import torch
from torch import Tensor

from articulate_ssl.geometry.se3 import invert_se3, se3
from articulate_ssl.inference.late_buffers import LateBuffers
from articulate_ssl.inference.prediction import Prediction

FEWEST = 32  # clouds from which it is learnt. Chosen.
# Of the base's spread, below which another part clearly stands steadier: a door that is hinged upright shows gravity as
# steadily as the body that it is on. Chosen.
_CLEARLY = 0.75


class StandingPart(LateBuffers):
    """The part that stands.

    Attributes:
        learnt: [] whether that is known.
        root: [] its number.
    """

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("learnt", torch.tensor(False))
        self.register_buffer("root", torch.tensor(0))

    def forget(self) -> None:
        """As before it was learnt."""
        self.learnt.fill_(False)

    def learn(
        self,
        rotation: Tensor,  # [n, K, 3, 3] of parts, canonical -> camera, of training clouds
        base: int,  # the part that the tree has for its root
    ) -> Tensor:  # [K] radians, how much each part's steadiest direction is spread
        """Find out which part stands; the base as it is, unless another is clearly steadier."""
        self.forget()
        spread = steadiness(rotation)
        if len(rotation) >= FEWEST:
            steadiest = int(spread.argmin())
            self.root.fill_(steadiest if spread[steadiest] < _CLEARLY * spread[base] else base)
            self.learnt.fill_(True)
        return spread

    def stood(self, prediction: Prediction) -> Prediction:
        """The same prediction, with the part that stands for its base."""
        return rerooted(prediction, int(self.root)) if self.learnt else prediction


def steadiness(
    rotation: Tensor,  # [n, K, 3, 3] canonical -> camera
) -> Tensor:  # [K] radians
    """The angle whose cosine is the longest mean, over clouds, that any unit direction of a part has for the camera."""
    return torch.linalg.matrix_norm(rotation.double().mean(dim=0), ord=2).clamp(max=1).arccos()


def rerooted(prediction: Prediction, root: int) -> Prediction:
    """The same parts, poses and joint states, as a tree that hangs from `root`.

    A joint that is turned round has the opposite axis, so that its state stays what it is.

    Raises:
        ValueError: if there is no such part, or clouds have different trees.
    """
    if not 0 <= root < prediction.num_parts:
        raise ValueError(f"part {root} cannot be the base of {prediction.num_parts} parts")
    trees = torch.stack([prediction.joint_parent, prediction.joint_child], dim=-1)  # [B, J, 2]
    if (trees != trees[:1]).any():
        raise ValueError("predictions have different trees: choose the base of one after the other")
    turned = _turned_round(trees[0].tolist(), root)
    if not any(turned):
        return prediction
    flip = torch.tensor(turned, device=prediction.joint_parent.device)
    sign = torch.where(flip, -1.0, 1.0).to(prediction.joint_axis)[:, None]
    pose = prediction.part_pose[:, root]
    assembled = se3(torch.eye(3).to(pose).expand(len(pose), 3, 3), prediction.assembly[:, root].to(pose))
    return replace(
        prediction,
        base_pose=pose @ invert_se3(assembled),
        joint_parent=torch.where(flip, prediction.joint_child, prediction.joint_parent),
        joint_child=torch.where(flip, prediction.joint_parent, prediction.joint_child),
        joint_axis=prediction.joint_axis * sign,
        canonical_axis=prediction.canonical_axis * sign,
    )


def _turned_round(joints: list[list[int]], root: int) -> list[bool]:
    """Whether each joint (parent, child) lies the wrong way round for a tree that hangs from `root`."""
    hung = set(nx.bfs_edges(nx.Graph(joints), root))
    return [(parent, child) not in hung for parent, child in joints]
