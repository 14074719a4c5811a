"""EPN, whole-shape reconstruction: an articulated object taken for a rigid one (paper, Sec. "Shape Reconstruction").

The paper compares Chamfer distances only, and so does this row: there are no parts in the model, and nothing here makes
any up. How far joints are open is one more thing that an instance's shape differs in.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from articulate_ssl.baselines.epn import READ_POINTS, SHAPE_POINTS, SIZE, RigidMethod
from articulate_ssl.baselines.implicit import segmentation
from articulate_ssl.baselines.method import RECONSTRUCTION, Effort, Problem
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.network.rigid_alignment import RigidAlignment

# How far a point of an instance is from the template's at most: a lid's edge travels its own length. Stage 0's bound
# (.05) would leave no shape but the template's.
_FLOW_BOUND = 0.5


class EPNWhole(RigidMethod):
    """One rigid object; of its prediction only the reconstruction is its own."""

    title = "EPN, whole shape"
    says = (RECONSTRUCTION,)
    effort = Effort(steps=2000, batch_size=16, learning_rate=2e-3)

    def __init__(self, problem: Problem) -> None:
        """Args: the category."""
        super().__init__(problem)
        # As many points as a reconstruction in parts has.
        self.network = RigidAlignment(SIZE, problem.num_parts * SHAPE_POINTS, _FLOW_BOUND)

    def training_step(self, batch: dict[str, Tensor], batch_idx: int) -> Tensor:
        """Stage 0's loss."""
        return self.rigid_loss(self.network, batch["points"][:, :READ_POINTS])

    @torch.no_grad()
    def predict(self, batch: dict[str, Tensor]) -> Prediction:
        """Reads `points`. All slots move as one; each holds an equal share of the shape's points, in no order."""
        points, K = batch["points"], self.problem.num_parts
        found = self.reconstruct(self.network, points[:, :READ_POINTS])
        one_part = torch.zeros(*points.shape[:2], K, dtype=points.dtype, device=points.device)
        one_part[..., 0] = 1
        return replace(
            segmentation(points, one_part),
            part_pose=found.pose[:, None].expand(-1, K, -1, -1),
            part_shape=found.shape.unflatten(1, (K, SHAPE_POINTS)),
            base_pose=found.pose,
            reconstruction_error=found.error,
            margin=found.margin,
        )
