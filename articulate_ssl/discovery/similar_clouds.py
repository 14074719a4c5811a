"""Which part a point is of, as in labelled clouds of other objects that its own is most like.

No one chest has its drawers where another has them, so one template says badly which drawer a point is of, however it
is stretched. Clouds of many chests say it well: labelled truly, by those of 120 objects, unseen chests had an mIoU of
85 %; by those of 15 objects 73 %, and 72 % with the labels that these objects' own clouds say; by the best single
template 51 %. Copies of them in other proportions and joint states (`varied_clouds`) say it better still
(docs/experiments.md, steps 100 and 103).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import one_hot

from articulate_ssl.discovery.distance_field import DistanceFields
from articulate_ssl.discovery.synchronization import CAP
from articulate_ssl.ops.chamfer import nearest_distance, nearest_index

# Points of each whose distances to a cloud say which clouds are compared with it at all, and how many are. By as many
# points on both sides instead of the cloud's distance field, 2 points of mIoU were lost; so none is.
_SCREENED, _SCREENS = 64, 512
ASKING = 1024  # points of a cloud whose distance field is compared with
_COMPARED = 256  # points of each by which clouds are compared
_VOTING = 32  # at most, and at most every fourth: of 3,944 clouds 8 and 16 were worse, 64 as good


class LabelledClouds(NamedTuple):
    """Clouds of several objects that stand alike, stretched to unit boxes (`synchronization.unit_boxes`).

    Attributes:
        points: [r, P, 3] farthest-point order.
        part: [r, P] which part every point belongs to.
    """

    points: Tensor
    part: Tensor

    def votes(
        self,
        boxes: Tensor,  # [n, N, 3] clouds that stand as these do, in unit boxes, farthest-point order (`ASKING`)
        num_parts: int,
        points: Tensor | None = None,  # [n, M, 3] that are asked for, in the same boxes; those of the clouds by default
    ) -> Tensor:  # [n, M, K]
        """Share of the clouds most like each in which the nearest point is of each part."""
        points = boxes if points is None else points
        return torch.stack([self._votes(box, asked, num_parts) for box, asked in zip(boxes, points, strict=True)])

    def _votes(self, box: Tensor, points: Tensor, num_parts: int) -> Tensor:
        far = DistanceFields.of(box[None]).at(0, self.points[:, :_SCREENED]).clamp(max=CAP).mean(dim=1)
        near = far.topk(min(_SCREENS, len(far)), largest=False).indices
        thin, copies = self.points[near, :_COMPARED], box[:_COMPARED].expand(len(near), -1, -1)
        there, back = (nearest_distance(*both).clamp(max=CAP) for both in ((copies, thin), (thin, copies)))
        voting = min(_VOTING, -(-len(far) // 4))
        alike = near[(there.mean(dim=1) + back.mean(dim=1)).topk(voting, largest=False).indices]
        nearest = nearest_index(points.expand(len(alike), -1, -1).contiguous(), self.points[alike].contiguous())
        return one_hot(self.part[alike].long().gather(1, nearest), num_parts).to(box).mean(dim=0)
