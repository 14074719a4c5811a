"""A frame that all clouds of a collection share: their Manhattan frames, synchronised."""

from __future__ import annotations

import logging

import torch
from torch import Tensor

from articulate_ssl.discovery.manhattan_frame import manhattan_frames
from articulate_ssl.discovery.synchronization import pairwise_costs, synchronise, unit_boxes
from articulate_ssl.geometry.rotation_group import rotation_group

# Mean angle, in degrees, between normals and axes, in the median over the clouds: .5 to .6 on procedural chests, 10
# where there are no planes. Beyond this, which was chosen in between, clouds have no Manhattan frame.
_LARGEST_ANGLE = 2.0

log = logging.getLogger(__name__)


def common_frame(
    clouds: Tensor,  # [n, N, 3] in any orientation
    generator: torch.Generator,
) -> Tensor | None:  # [n, 3, 3]
    """Rotations that turn all clouds alike, with their surfaces along the axes; None if they have no such frames."""
    rotation, angle = manhattan_frames(clouds, generator)
    log.info("Manhattan frames: normals %.1f degrees from their axes in the median", angle.median())
    if angle.median() > _LARGEST_ANGLE:
        return None
    group = rotation_group(24)
    boxes, _, _ = unit_boxes(clouds @ rotation.mT)
    element = synchronise(pairwise_costs(boxes, group), group, generator)
    return group.elements.to(clouds)[element] @ rotation
