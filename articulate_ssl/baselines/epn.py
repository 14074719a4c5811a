"""EPN (Chen et al. 2021) without labels: a rigid thing's shape and pose from reconstruction, min over the group.

What two rows of the table share. The auto-encoder is our stage 0 (`network/rigid_alignment.py`), which is EPN's: an
invariant canonical shape, one residual pose per element of the group, and the best of these reconstructions trains.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from articulate_ssl.baselines.method import Method, Problem
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.inference.candidates import rivals
from articulate_ssl.losses.objective import rigid_loss
from articulate_ssl.network.options import NetworkOptions
from articulate_ssl.network.rigid_alignment import RigidAlignment
from articulate_ssl.ops.chamfer import hypothesis_distances
from datamodules.articulated_data_module import ArticulatedDataModule

SHAPE_POINTS = 256  # of a canonical shape, as the CPU profile has it
READ_POINTS = 256  # leading points that a network reads, likewise
# The network of the CPU profile (`cli/cpu_profile.yaml`), so that rows differ in method and not in size.
SIZE = NetworkOptions(
    group_order=12,
    dims=[16, 32, 64],
    radii=[0.12, 0.2, 0.3],
    num_neighbors=16,
    num_kernel_points=13,
    num_centers=[256, 128, 64],
    head_dim=64,
)


class RigidObject(NamedTuple):
    """What EPN says about B clouds.

    Attributes:
        shape: [B, M, 3] in canonical space.
        pose: [B, 4, 4] canonical space -> camera space.
        error: [B] distance between the cloud and its reconstruction.
        margin: [B] as in `Prediction`.
    """

    shape: Tensor
    pose: Tensor
    error: Tensor
    margin: Tensor


class RigidMethod(Method):
    """A method whose networks take what they see for rigid."""

    labelled_spaces = False

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem)
        # Views show one side only: then a reconstruction does not pay for what the cloud lacks.
        self.register_buffer("bidirectional", torch.tensor(True))

    def prepare(self, data: ArticulatedDataModule, seed: int) -> None:
        """Whether clouds are complete."""
        self.bidirectional.fill_(data.manifest.view == "complete")

    def rigid_loss(self, network: RigidAlignment, points: Tensor) -> Tensor:
        """min_g d(X, Y^g), averaged over the batch."""
        return rigid_loss(network(points), points, bool(self.bidirectional))

    def reconstruct(self, network: RigidAlignment, points: Tensor) -> RigidObject:
        """The best hypothesis for every cloud [B, N, 3]."""
        hypotheses = network(points)
        error = hypothesis_distances(points, hypotheses.posed(), bidirectional=bool(self.bidirectional))
        pose = se3(hypotheses.rotation, hypotheses.translation)
        best = error.argmin(1)
        _, margin = rivals(error, pose, best, torch.ones_like(error, dtype=torch.bool))
        rows = torch.arange(len(points), device=points.device)
        return RigidObject(hypotheses.shape, pose[rows, best], error[rows, best], margin)
