"""A frame that all clouds of a collection share: their Manhattan frames, synchronised."""

from __future__ import annotations

import logging

import torch
from torch import Tensor

from articulate_ssl.discovery.manhattan_frame import manhattan_frames
from articulate_ssl.discovery.synchronization import pairwise_costs, synchronise, unit_boxes
from articulate_ssl.geometry.rotation_group import rotation_group

# Mean angle, in degrees, between normals and axes, in the median over the clouds. Procedural chests: .3 to .6 where few
# points see a plane, 3.7 where many do, some of them across edges, 4.3 to 6 with noise up to .01, and their frames are
# right (docs/experiments.md, step 208); 9.4 to 10 where there are no planes. Chosen in between.
_LARGEST_ANGLE = 7.5

log = logging.getLogger(__name__)


def common_frame(
    clouds: Tensor,  # [n, N, 3] in any orientation
    generator: torch.Generator,
    whole: bool = True,
) -> Tensor | None:  # [n, 3, 3]
    """Rotations that turn all clouds alike, with their surfaces along the axes; None if they have no such frames.

    Args:
        whole: Whether clouds show all sides (`manhattan_frames`).
    """
    rotation, angle = manhattan_frames(clouds, generator, whole)
    log.info("Manhattan frames: normals %.1f degrees from their axes in the median", angle.median())
    if angle.median() > _LARGEST_ANGLE:
        return None
    group = rotation_group(24)
    boxes, _, _ = unit_boxes(clouds @ rotation.mT)
    element = synchronise(pairwise_costs(boxes, group), group, generator)
    return group.elements.to(clouds)[element] @ rotation
