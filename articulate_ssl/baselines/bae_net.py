"""BAE-Net (Chen, Yin, Fisher, Chaudhuri and Zhang 2019): an autoencoder whose decoder has a branch for each part.

A shape's code and a point go through three layers; the last has one sigmoid per branch, and the point is inside the
shape if it is inside a branch: the maximum of all. Nothing but reconstruction is asked for (their unsupervised loss,
the mean squared difference to the occupancy). A decoder this shallow can reconstruct a collection only if each branch
keeps to what recurs in it, and that is the segmentation: a point belongs to the branch of largest value.

As theirs: three layers of which the first two are leaky rectifiers, the loss, Adam. Otherwise: the code comes from the
cloud (`implicit.py`); 512 and 128 units instead of 3072 and 384, so that training takes minutes of a CPU; as many
branches as parts, so that a branch is a slot and no label has to say which branches make up a part.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu, mse_loss

from articulate_ssl.baselines.implicit import COORDINATES, SLOPE, CloudEncoder, draw_samples, segmentation
from articulate_ssl.baselines.method import OCCUPANCY, SEGMENTATION, Effort, Method, Problem
from articulate_ssl.inference.prediction import Prediction

CODE = 128
UNITS = (512, 128)
_TINY = 1e-12  # added to values that are normalised to probabilities


class BranchedDecoder(nn.Module):
    """Inside or not, for every branch.

    Args:
        code: Length of a shape's code.
        branches: K.
    """

    def __init__(self, code: int, branches: int) -> None:
        super().__init__()
        # One layer that reads code and point, in two pieces: a shape's piece is the same for all its points.
        self.shape = nn.Linear(code, UNITS[0])
        self.point = nn.Linear(3, UNITS[0], bias=False)
        self.hidden = nn.Linear(*UNITS)
        self.branch = nn.Linear(UNITS[1], branches)

    def forward(
        self,
        code: Tensor,  # [B, code]
        points: Tensor,  # [B, M, 3]
    ) -> Tensor:  # [B, M, K]
        """Value of every branch in (0, 1)."""
        first = leaky_relu(self.shape(code)[:, None] + self.point(COORDINATES * points), SLOPE)
        return self.branch(leaky_relu(self.hidden(first), SLOPE)).sigmoid()


class BAENet(Method):
    """Branches of an implicit decoder as parts.

    Args:
        problem: What is known of the category.
    """

    title = "BAE-Net"
    given = (OCCUPANCY,)
    says = (SEGMENTATION,)
    effort = Effort(steps=3000, batch_size=16, learning_rate=1e-3)

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem)
        self.encoder = CloudEncoder(CODE)
        self.decoder = BranchedDecoder(CODE, problem.num_parts)

    def training_step(self, batch: dict[str, Tensor], batch_idx: int) -> Tensor:
        """Mean squared difference between the largest branch and the occupancy."""
        points, occupancy = draw_samples(batch)
        return mse_loss(self.decoder(self.encoder(batch["points"]), points).amax(-1), occupancy)

    @torch.no_grad()
    def predict(self, batch: dict[str, Tensor]) -> Prediction:
        """Every point belongs to the branch of largest value there."""
        points = batch["points"]
        value = self.decoder(self.encoder(points), points) + _TINY
        return segmentation(points, value / value.sum(-1, keepdim=True))
