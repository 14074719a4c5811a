"""Part-by-part shape reconstruction (paper, Sec. 3.3): the distance between a cloud and its posed canonical parts.

All distances are of L1 type (unsquared): with squared ones a laptop whose base and lid are exchanged is a stable
optimum, because a few far points outweigh many near ones.
"""

from __future__ import annotations

import torch
from torch import Tensor

from articulate_ssl.ops.chamfer import nearest_index

_TINY = 1e-8


def distances_to_parts(
    points: Tensor,  # [B, N, 3]
    posed: Tensor,  # [B, K, M, 3]
) -> Tensor:  # [B, N, K]
    """Distance of every input point to every posed part; differentiable in the parts."""
    query = points[:, None].expand(-1, posed.shape[1], -1, -1)
    return _gap(query, posed, nearest_index(query, posed)).transpose(1, 2)


def distances_to_cloud(
    posed: Tensor,  # [B, K, M, 3]
    points: Tensor,  # [B, N, 3]
    labels: Tensor | None = None,  # [B, N]
) -> Tensor:  # [B, K, M]
    """Distance of every posed point to the nearest input point; with labels, to the nearest point of its own part.

    A part that owns no input point is compared with all of them.
    """
    target = points[:, None].expand(-1, posed.shape[1], -1, -1)
    foreign = None
    if labels is not None:
        foreign = labels[:, None] != torch.arange(posed.shape[1], device=points.device)[:, None]  # [B, K, N]
        foreign = foreign & ~foreign.all(dim=-1, keepdim=True)
    return _gap(posed, target, nearest_index(posed, target, foreign))


def posterior_association(
    to_part: Tensor,  # [B, N, K]
    scale: float,
) -> Tensor:  # [B, N, K]
    """Posterior of the parts given the posed shapes, softmax(-d^2 / 2 s^2), without gradient."""
    return (to_part.detach().square() / (-2 * scale**2)).softmax(dim=-1)


def part_by_part(
    to_part: Tensor,  # [B, N, K]
    to_cloud: Tensor | None,  # [B, K, M], None for the unidirectional distance
    association: Tensor,  # [B, N, K], rows sum to one
) -> Tensor:  # [B]
    """Association-weighted distance of the input to the parts, plus that of the parts to the input."""
    loss = (association * to_part).sum(dim=-1).mean(dim=-1)
    return loss if to_cloud is None else loss + to_cloud.mean(dim=(-1, -2))


def whole_shape(
    to_part: Tensor,  # [B, N, K]
    to_cloud: Tensor | None,  # [B, K, M], without labels
) -> Tensor:  # [B]
    """d(X, Y): Chamfer distance between the input and the union of the posed parts."""
    loss = to_part.amin(dim=-1).mean(dim=-1)
    return loss if to_cloud is None else loss + to_cloud.mean(dim=(-1, -2))


def _gap(query: Tensor, target: Tensor, index: Tensor) -> Tensor:
    """Length of query - target[index], with a finite gradient at zero."""
    near = target.gather(-2, index[..., None].expand_as(query))
    return ((query - near).square().sum(dim=-1) + _TINY).sqrt()
