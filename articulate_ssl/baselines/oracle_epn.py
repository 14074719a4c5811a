"""Oracle EPN, which the paper's appendix compares with: true parts, each a rigid thing whose pose EPN finds alone.

One auto-encoder per part learns without poses from clouds of that part. Joints are out of its reach (paper, appendix
"Comparison with Other Baselines"), and a part that looks like itself from behind has no one pose.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn
from torch.nn.functional import one_hot

from articulate_ssl.baselines.epn import READ_POINTS, SHAPE_POINTS, SIZE, RigidMethod
from articulate_ssl.baselines.implicit import segmentation
from articulate_ssl.baselines.method import PART_LABELS, POSES, TEST_PARTS, Effort, Problem
from articulate_ssl.baselines.perfect_oracle import part_points
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.network.rigid_alignment import RigidAlignment

_FLOW_BOUND = 0.1  # what an instance's part differs from the category's at most, as in the articulated network


class OracleEPN(RigidMethod):
    """Poses of true parts; canonical part spaces are its own, so metrics calibrate on its training predictions."""

    title = "Oracle EPN"
    given = (PART_LABELS, TEST_PARTS)
    says = (POSES,)
    effort = Effort(steps=2000, batch_size=16, learning_rate=2e-3)

    def __init__(self, problem: Problem) -> None:
        """Args: the category."""
        super().__init__(problem)
        self.networks = nn.ModuleList(RigidAlignment(SIZE, SHAPE_POINTS, _FLOW_BOUND) for _ in range(problem.num_parts))

    def training_step(self, batch: dict[str, Tensor], batch_idx: int) -> Tensor:
        """Sum of the parts' losses."""
        parts = self.true_parts(batch)
        return sum(self.rigid_loss(network, parts[:, k]) for k, network in enumerate(self.networks))

    def true_parts(self, batch: dict[str, Tensor]) -> Tensor:
        """Every part's own points of the dense cloud, the first of them, [B, K, READ_POINTS, 3].

        A part that is not seen at all is the cloud's centre.

        Raises:
            ValueError: if the batch does not tell parts.
        """
        if "dense_part_id" not in batch:
            raise ValueError("Oracle EPN reads true parts: open the data with dense_in_fit=True")
        points, labels, K = batch["dense_points"], batch["dense_part_id"], self.problem.num_parts
        return torch.stack(
            [
                torch.stack([part_points(cloud, part_id, k, READ_POINTS, cloud.mean(0)) for k in range(K)])
                for cloud, part_id in zip(points, labels, strict=True)
            ]
        )

    @torch.no_grad()
    def predict(self, batch: dict[str, Tensor]) -> Prediction:
        """Reads `points`, which lead the dense ones, and the true part of these."""
        parts, points = self.true_parts(batch), batch["points"]
        found = [self.reconstruct(network, parts[:, k]) for k, network in enumerate(self.networks)]
        pose = torch.stack([f.pose for f in found], dim=1)
        part_id = batch["dense_part_id"][:, : points.shape[1]].long()
        return replace(
            segmentation(points, one_hot(part_id, self.problem.num_parts).to(points.dtype)),
            part_pose=pose,
            part_shape=torch.stack([f.shape for f in found], dim=1),
            base_pose=pose[:, 0],
            reconstruction_error=torch.stack([f.error for f in found]).mean(0),
            # It is as sure as it is of the part that it is least sure of.
            margin=torch.stack([f.margin for f in found]).amin(0),
        )
