"""A network that says which part points are of, in clouds of objects that stand alike.

Other objects' clouds say it, too (`discovery.similar_clouds`), but as a whole: where one has its middle drawer high and
its bottom one open, few of them have both. The network is taught by the same labels, which no one gave
(`training/part_lessons.py`), and sees where surfaces are: of unseen chests it has more points right than those votes
have by true labels (docs/experiments.md, step 179).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from articulate_ssl.discovery.synchronization import unit_boxes
from articulate_ssl.network.surface_network import SurfaceCloud, SurfaceNetwork, SurfaceSize, layer
from articulate_ssl.ops.spin_images import DENSE_POINTS, SPIN_CHANNELS, spin_images

SIZE = SurfaceSize(read=512, centers=256, radii=(0.12, 0.25, 0.4))  # radii in widths of the box; chosen


class PartNetwork(SurfaceNetwork):
    """Whole-cloud and local features of clouds in unit boxes, and a perceptron that every point asks."""

    def __init__(self, num_parts: int, size: SurfaceSize = SIZE) -> None:
        """Args: K; sizes."""
        super().__init__(size)
        self.num_parts, self.size = num_parts, size
        first, last, dim = size.dims[0], size.dims[-1], size.head_dim
        inputs = first + last + dim + 3 + SPIN_CHANNELS + 3
        self.point = nn.Sequential(*layer(inputs, dim), *layer(dim, dim), nn.Linear(dim, num_parts))

    def logits(
        self,
        boxes: Tensor,  # [B, N, 3] clouds that stand alike, in unit boxes, farthest-point order
        images: Tensor,  # [B, N, SPIN_CHANNELS] of their points, before they were stretched to boxes
        normal: Tensor,  # [B, N, 3] likewise
    ) -> Tensor:  # [B, N, K]
        """Of every part, for every point."""
        read = slice(self.size.read)
        cloud = SurfaceCloud.of(boxes, images[:, read], normal[:, read], self.size)
        local, whole = self.describe(cloud)
        whole = whole[:, None].expand(-1, boxes.shape[1], -1)
        return self.point(torch.cat([cloud.carried(local), whole, cloud.points, images, normal], dim=-1))

    @torch.no_grad()
    def probability(
        self,
        clouds: Tensor,  # [B, N, 3] farthest-point order
        turn: Tensor,  # [B, C, 3, 3] by which they stand as the collection does, or might
    ) -> Tensor:  # [B, C, N, K]
        """That points are of parts, if clouds are turned so."""
        boxes = unit_boxes(torch.einsum("bcij,bnj->bcni", turn, clouds).flatten(0, 1))[0].unflatten(0, turn.shape[:2])
        found = boxes.new_empty(*boxes.shape[:3], self.num_parts)
        for own in looks(clouds.shape[1], DENSE_POINTS):
            images, normal = spin_images(clouds[:, own], clouds[:, own])
            images = images[:, None].expand(-1, turn.shape[1], -1, -1)
            normal = torch.einsum("bcij,bnj->bcni", turn, normal)
            said, seen = found[:, :, own], (boxes[:, :, own], images, normal)
            for some in looks(normal.shape[2], self.size.read):
                logits = self.logits(*(x[:, :, some].flatten(0, 1) for x in seen))
                said[:, :, some] = logits.unflatten(0, turn.shape[:2]).softmax(-1)
        return found


def looks(count: int, size: int) -> list[slice]:
    """As many even shares of points in farthest-point order as have so many points each, or one."""
    shares = max(1, count // size)
    return [slice(first, None, shares) for first in range(shares)]
