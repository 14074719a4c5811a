"""A network that says which part points of a depth view are of, where it is known how the object is turned.

Views that are alike say it, too (`view_search`), and so does the shape that is fitted to the view; the three together
are right more often than any two (docs/experiments.md, step 185). It is taught by simulated views
(`training/view_lessons.py`), of which few points are kept, and sees where these are, not what surfaces are like: with
spin images of denser views it was no better.
"""

from __future__ import annotations

import torch
from torch import Tensor

from articulate_ssl.discovery.synchronization import unit_boxes
from articulate_ssl.inference.part_network import PartNetwork, looks
from articulate_ssl.inference.votes import Votes
from articulate_ssl.network.surface_network import SurfaceSize
from articulate_ssl.ops.spin_images import SPIN_CHANNELS

SIZE = SurfaceSize(read=256, centers=128, radii=(0.15, 0.3, 0.45))  # radii in widths of the box; chosen
_SAYS = 0.5  # of what similar views and this network say together. Chosen.


class ViewParts(PartNetwork):
    """As `PartNetwork`, of points alone."""

    def __init__(self, num_parts: int, size: SurfaceSize = SIZE) -> None:
        """Args: K; sizes."""
        super().__init__(num_parts, size)

    def of_points(
        self,
        boxes: Tensor,  # [B, N, 3] views whose objects stand alike, in unit boxes, farthest-point order
    ) -> Tensor:  # [B, N, K]
        """Logits of every part, for every point."""
        nothing = boxes.new_zeros(1, 1, 1).expand(*boxes.shape[:2], SPIN_CHANNELS)
        return self.logits(boxes, nothing, nothing[..., :3])

    @torch.no_grad()
    def beside(
        self,
        votes: Votes,  # of B views
        views: Tensor,  # [B, N, 3] farthest-point order
        turn: Tensor,  # [B, 3, 3] by which their objects stand as those that taught it
    ) -> Votes:
        """What is said of all points, by this network, too."""
        boxes = unit_boxes(views @ turn.mT)[0]
        said = boxes.new_empty(*boxes.shape[:2], self.num_parts)
        for some in looks(boxes.shape[1], self.size.read):
            said[:, some] = self.of_points(boxes[:, some]).softmax(-1)
        return Votes(views, torch.lerp(votes.at(views), said, _SAYS))
