"""How `inference.part_network` is taught: by clouds whose points have parts as their own objects move.

No label is read. Every time a cloud is shown, it is of other points, in other proportions, and in two times of three
its parts have slid (`discovery.varied_clouds`), so that a hundred objects show what thousands would.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from articulate_ssl.discovery.similar_clouds import LabelledClouds
from articulate_ssl.discovery.synchronization import unit_boxes
from articulate_ssl.discovery.varied_clouds import in_other_proportions, in_other_states
from articulate_ssl.inference.part_network import PartNetwork, looks
from articulate_ssl.ops.progress import announced, tell
from articulate_ssl.ops.spin_images import DENSE_POINTS, spin_images
from articulate_ssl.shape.joints import Joints

_STEPS, BATCH, _RATE = 2000, 16, 2e-3  # of 179 chests: .86 of unseen ones after 500 steps, .91 after 1,000
_UNMOVED = 5  # clouds of a batch whose parts stay where they are
_SHOWN = 2  # times as many points as the network reads are known, of which it reads some
_SMOOTHING = 0.05  # of labels, of which some are wrong
_DECAY, _GRADIENT_NORM = 1e-4, 1.0
_CHUNK = 16  # clouds at a time

log = logging.getLogger(__name__)


class PartLessons(NamedTuple):
    """Clouds that stand alike, whose points have parts: even shares of their points, as the network will see them.

    Attributes:
        boxes: [n, N, 3] in unit boxes, farthest-point order.
        images: [n, N, SPIN_CHANNELS] float16.
        normal: [n, N, 3] float16.
        part: [n, N]
    """

    boxes: Tensor
    images: Tensor
    normal: Tensor
    part: Tensor

    @staticmethod
    @torch.no_grad()
    def of(
        standing: Tensor,  # [n, P, 3] farthest-point order
        part: Tensor,  # [n, M] of the leading points
        size: int,
    ) -> PartLessons:
        """Of so many points of every share."""
        boxes, found = unit_boxes(standing)[0], []
        for own in looks(standing.shape[1], DENSE_POINTS):
            known = part[:, own][:, :size]
            count, dense = known.shape[1], standing[:, own]
            both = [spin_images(some[:, :count], some) for some in dense.split(_CHUNK)]
            images, normal = (torch.cat(some).half() for some in zip(*both, strict=True))
            found.append(PartLessons(boxes[:, own][:, :count], images, normal, known.long()))
        count = min(one.part.shape[1] for one in found)
        return PartLessons(*(torch.cat([x[:, :count] for x in some]) for some in zip(*found, strict=True)))

    def draw(self, joints: Joints, read: int, generator: torch.Generator) -> PartLessons:
        """Some of the clouds, of points drawn anew, in other proportions and joint states."""
        rows = torch.randint(len(self.part), (BATCH, 1), generator=generator)
        # In farthest-point order again, so that what is left after a layer is even.
        seen = torch.rand(BATCH, self.part.shape[1], generator=generator).argsort(dim=1)[:, :read].sort(dim=1).values
        boxes, images, normal, part = (x[rows, seen] for x in self)
        still, moved = boxes[:_UNMOVED], LabelledClouds(boxes[_UNMOVED:], part[_UNMOVED:])
        copies = in_other_proportions(still, 1, generator)[_UNMOVED:], in_other_states(moved, joints, generator)
        return PartLessons(torch.cat(copies), images.float(), normal.float(), part)


def teach_parts(
    standing: Tensor,  # [n, P, 3] clouds that stand as the collection does, farthest-point order
    part: Tensor,  # [n, M] of their leading points
    joints: Joints,  # of the parts, in that frame
) -> PartNetwork:
    """A new network that has learnt them."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = PartNetwork(joints.chain.num_parts)
        lessons = PartLessons.of(standing, part, _SHOWN * network.size.read)

        def drawn(generator: torch.Generator) -> tuple[Tensor, Tensor]:
            shown = lessons.draw(joints, network.size.read, generator)
            return network.logits(*shown[:3]), shown.part

        teach(network, drawn, f"parts of {len(standing)} clouds")
        return network


def teach(
    network: nn.Module,
    drawn: Callable[[torch.Generator], tuple[Tensor, Tensor]],
    what: str,
) -> None:
    """Teach a network parts; afterwards it does not learn any more.

    Args:
        drawn: What it says of a batch of clouds [B, N, K], and which part their points are of [B, N].
        what: It learns, as progress is called.
    """
    generator, loss = torch.Generator().manual_seed(0), torch.tensor(0.0)
    with torch.enable_grad():
        optimizer = torch.optim.AdamW(network.parameters(), lr=_RATE, weight_decay=_DECAY)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, _STEPS)
        for _ in announced(log, f"a network learns {what}", range(_STEPS)):
            logits, part = drawn(generator)
            loss = functional.cross_entropy(logits.flatten(0, 1), part.flatten(), label_smoothing=_SMOOTHING)
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), _GRADIENT_NORM)
            optimizer.step()
            schedule.step()
    tell(log, "a network has learnt %s, to a loss of %.2f", what, loss.item())
    network.eval().requires_grad_(False)
