"""How `inference.view_parts` is taught: by the simulated views that are kept, whose parts and poses are known.

No label is read: which part their points are of was found with them. Every time a view is shown, its object is in other
proportions and turned a little, as predictions are off a little.
"""

from __future__ import annotations

import roma
import torch
from torch import Tensor

from articulate_ssl.discovery.synchronization import unit_boxes
from articulate_ssl.discovery.varied_clouds import in_other_proportions
from articulate_ssl.inference.view_parts import ViewParts
from articulate_ssl.training.part_lessons import BATCH, teach

_TURNED = 0.02  # radians, standard deviation about each axis. Chosen.


def teach_view_parts(
    standing: Tensor,  # [n, N, 3] views whose objects stand along their axes, farthest-point order
    part: Tensor,  # [n, N]
    num_parts: int,
) -> ViewParts:
    """A new network that has learnt them."""

    def drawn(generator: torch.Generator) -> tuple[Tensor, Tensor]:
        rows = torch.randint(len(standing), (BATCH,), generator=generator)
        turn = roma.rotvec_to_rotmat(_TURNED * torch.randn(BATCH, 3, generator=generator)).to(standing)
        boxes = unit_boxes(standing[rows] @ turn)[0]
        return network.of_points(in_other_proportions(boxes, 1, generator)[BATCH:]), part[rows].long()

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = ViewParts(num_parts).to(standing)
        teach(network, drawn, f"parts of {len(standing)} views")
        return network
