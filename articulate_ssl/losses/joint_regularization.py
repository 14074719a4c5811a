"""Joint regularization L_reg (paper, Sec. 3.3): a joint's line must touch both parts it connects.

Pairs of parts are weighted by the probability that they are adjacent (edge marginals over spanning trees), so this loss
also trains the adjacency confidences from which the kinematic chain is extracted; the original has no such signal.
"""

from __future__ import annotations

import torch
from torch import Tensor

from articulate_ssl.geometry.kinematic_chain import edge_marginals, pair_index
from articulate_ssl.geometry.screw import REVOLUTE


def joint_line_points(
    pivot: Tensor,  # [B, E, 3]
    axis: Tensor,  # [B, E, 3]
    extent: float,
    count: int = 7,
) -> Tensor:  # [B, E, count, 3]
    """P^v: points on the joint line, evenly spaced within `extent` on both sides of the pivot."""
    shift = torch.linspace(-extent, extent, count, device=pivot.device, dtype=pivot.dtype)
    return pivot[:, :, None] + shift[:, None] * axis[:, :, None]


def joint_regularization(
    canonical: Tensor,  # [B, K, M, 3] canonical object shape, parts at rest
    articulated: Tensor,  # [B, K, M, 3] the same after the articulated motion, base fixed
    pivot: Tensor,  # [B, E, 3] of all part pairs
    axis: Tensor,  # [B, E, 3]
    confidence: Tensor,  # [B, E]
    joint_type: int,
    extent: float,
) -> Tensor:  # [B]
    """Expected distance, over spanning trees, of joint-line points to both parts before and after articulation.

    A prismatic joint's axis is free to lie anywhere: only its pivot is pulled to the parts.
    """
    parts = canonical.shape[1]
    pairs = pair_index(parts).to(pivot.device)
    line = joint_line_points(pivot, axis, extent) if joint_type == REVOLUTE else pivot[:, :, None]
    total = pivot.new_zeros(pivot.shape[:2])
    for shape in (canonical, articulated):
        for side in range(2):
            part = shape[:, pairs[:, side]]  # [B, E, M, 3]
            with torch.no_grad():
                index = torch.cdist(line, part).argmin(dim=-1)[..., None].expand(-1, -1, -1, 3)
            gap = (line - part.gather(2, index)).square().sum(dim=-1)
            total = total + (gap + 1e-8).sqrt().mean(dim=-1)
    return (edge_marginals(confidence, parts) * total).sum(dim=-1)
