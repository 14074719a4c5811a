"""What the networks propose of clouds, before anything is registered or decided: alignment and iteration.

Stage 0 turns whole clouds to roughly canonical orientation, and the articulated network gives a hypothesis per group
element; from the second pass on it reads the cloud in the part frames of the last winner (paper, Sec. 3.1). On a GPU
all of that is replayed for single clouds (`ops.replay`).
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from articulate_ssl.geometry.kinematic_chain import KinematicChain
from articulate_ssl.geometry.se3 import invert_se3, se3, transform_points
from articulate_ssl.inference.candidates import Iteration
from articulate_ssl.losses.reconstruction import distances_to_parts
from articulate_ssl.network.articulated_network import ArticulatedNetwork
from articulate_ssl.network.hypotheses import Hypotheses
from articulate_ssl.network.rigid_alignment import RigidAlignment
from articulate_ssl.ops.chamfer import hypothesis_distances
from articulate_ssl.ops.replay import Replay
from articulate_ssl.shape.observation import Observation


class Proposals:
    """Hypotheses of a module's networks.

    Args:
        articulated: The articulated network.
        rigid: Stage 0's network, or None where clouds are taken as they come.
        iterations: Pose estimations per cloud.
        observation: How clouds are taken.

    Attributes:
        agreement, compared: See `Iteration`; recipes may set them.
    """

    agreement: float = 0.0
    compared: int | None = None

    def __init__(
        self,
        articulated: ArticulatedNetwork,
        rigid: RigidAlignment | None,
        iterations: int,
        observation: Observation,
    ) -> None:
        self.articulated, self.rigid, self.iterations = articulated, rigid, iterations
        self.observation = observation
        self._replay = Replay(self._weights, _copied)

    def align(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Stage 0: clouds turned roughly to canonical orientation [B, N, 3], and the pose [B, 4, 4] that undoes it."""
        if self.rigid is None:
            return points, torch.eye(4, dtype=points.dtype, device=points.device).expand(len(points), 4, 4)
        with torch.no_grad():
            hypotheses = self.rigid(points)
            distance = hypothesis_distances(points, hypotheses.posed(), bidirectional=self.observation.bidirectional)
            best = distance.argmin(dim=1)
            rows = torch.arange(len(points), device=points.device)
            pose = se3(hypotheses.rotation[rows, best], hypotheses.translation[rows, best])
        return transform_points(invert_se3(pose), points), pose

    def iterate(
        self,
        points: Tensor,  # [B, N, 3] aligned
        chain: KinematicChain | None = None,
        observation: Observation | None = None,
    ) -> Iterator[Iteration]:
        """Pose estimations, each from the winner of the one before.

        Args:
            chain: The category's, if it was asked for already.
            observation: `Observation.known`, if it was.
        """
        start, labels = None, None
        chain, observation = chain or self.articulated.category.chain(), observation or self.observation
        for number in range(self.iterations):
            hypotheses = self.articulated(points, start, labels, chain)
            iteration = Iteration(points, hypotheses, start, observation, self.agreement, self.compared)
            yield iteration
            if number + 1 < self.iterations:
                start = hypotheses.select(iteration.winner)
                labels = distances_to_parts(points, start.posed()[:, 0]).argmin(dim=-1)

    def proposed(
        self,
        points: Tensor,  # [B, N, 3]
    ) -> tuple[Hypotheses, Tensor, Tensor]:  # [B, H], [B, 4, 4]
        """What the networks say: hypotheses in the aligned frame, their errors, and the pose of that frame."""
        chain, observation = self.articulated.category.chain(), self.observation.known()

        def say(clouds: Tensor) -> tuple[Hypotheses, Tensor, Tensor]:
            aligned, pose = self.align(clouds)
            *_, last = self.iterate(aligned, chain, observation)
            return last.hypotheses, last.distance, pose

        if observation.camera is not None:  # which way is up is read on the host
            return say(points)
        network = self.articulated
        how = self.agreement, self.compared, network.shape_head.freedom, network.mixed_precision, network.training
        return self._replay(say, points, (chain, *how))

    def _weights(self) -> Iterator[Tensor]:
        """All tensors that the networks read."""
        for network in filter(None, (self.articulated, self.rigid)):
            yield from network.parameters()
            yield from network.buffers()


def _copied(proposed: tuple[Hypotheses, Tensor, Tensor]) -> tuple[Hypotheses, Tensor, Tensor]:
    """See `Proposals.proposed`."""
    hypotheses, error, pose = proposed
    every = torch.arange(len(error), device=error.device)
    return hypotheses.rows(every), error.clone(), pose.clone()
