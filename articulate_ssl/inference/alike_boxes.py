"""In which of the ways that a box may be turned its cloud is most like training clouds.

What fits, and what a network sees of a surface from near, say little of whole clouds: an open door may be left over,
or be part of a body that is closed. So a few training clouds are kept as predictions turn them, as they are and with
their doors nearly closed (`training/alike_lesson.py`). All boxes are stretched to one, so that proportions do not
matter, and of the 24 rotations those are likelier in which the few clouds most alike are nearer.

Those that are kept are hinged as most are. What is hinged at another side and open looks as if it lay.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from articulate_ssl.discovery.synchronization import distances_to_others, mean_of_nearest, unit_boxes
from articulate_ssl.ops.few_bytes import from_few_bytes, in_few_bytes

GALLERY_POINTS = 64  # of a cloud that is kept; as of chests, whose turns 128 do not tell better (step 352)


class AlikeBoxes(nn.Module):
    """See above. It computes on the CPU, wherever its buffers are, because distance fields do.

    Attributes:
        gallery: [n, P, 3] int8, training clouds in boxes of width one, standing, in steps of `step` [n].
        weight: By how much likelier something is, as a logarithm, by that of how much nearer clouds are.
    """

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("gallery", torch.zeros(0, GALLERY_POINTS, 3, dtype=torch.int8))
        self.register_buffer("step", torch.zeros(0))
        self.register_buffer("weight", torch.zeros(()))

    @property
    def learnt(self) -> bool:
        """Whether there is anything to compare with."""
        return len(self.gallery) > 0

    def learn(
        self,
        standing: Tensor,  # [n, N, 3] farthest-point order
        weight: float,
    ) -> None:
        """Keep clouds that stand."""
        boxes, _, _ = unit_boxes(standing)
        rounded, step = in_few_bytes(boxes[:, :GALLERY_POINTS])
        self.gallery, self.step = rounded.to(self.gallery), step.to(self.step)
        self.weight.fill_(weight)

    def forget(self) -> None:
        """As before anything was learnt."""
        self.gallery, self.step = self.gallery[:0], self.step[:0]

    @torch.no_grad()
    def likely(
        self,
        dense: Tensor,  # [B, P, 3] farthest-point order
        standing: Tensor,  # [B, G, 3, 3] frames in which clouds may stand -> camera, a cube's rotations apart
    ) -> Tensor:  # [B, G]
        """Logarithms of how likely each is; zeros before anything was learnt."""
        if not self.learnt:
            return dense.new_zeros(standing.shape[:2])
        gallery = from_few_bytes(self.gallery.cpu(), self.step.cpu())
        distance = [distances_to_others(*some, gallery) for some in zip(dense.cpu(), standing.cpu(), strict=True)]
        return (-self.weight * mean_of_nearest(torch.stack(distance)).log().to(dense)).log_softmax(dim=1)

    def _load_from_state_dict(self, state_dict: dict, prefix: str, *rest) -> None:
        """Galleries have any size; weights from before there was one have none."""
        for name, own in list(self.named_buffers(recurse=False)):
            value = state_dict.setdefault(prefix + name, own.clone())
            setattr(self, name, torch.empty_like(value, dtype=own.dtype, device=own.device))
        super()._load_from_state_dict(state_dict, prefix, *rest)
